"""``python -m softmpm_learn``, also installed as ``softmpm-learn``."""

import sys
from pathlib import Path

from softmpm_learn.stop import Signals


def main() -> None:
    """Print the help at once, or import the program, which takes seconds, and run it."""
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(help_text())
        return
    signals = Signals()
    signals.install()  # before the imports that take seconds

    from softmpm_learn.app import main as run

    run(signals)


def help_text() -> str:
    """The template of ``conf/config.yaml``, from which Hydra would print the same."""
    from omegaconf import OmegaConf

    here = Path(__file__).resolve().parent
    places = (here / "conf" / "config.yaml", here.parents[1] / "conf" / "config.yaml")
    path = next(place for place in places if place.is_file())
    return OmegaConf.load(path).hydra.help.template


if __name__ == "__main__":
    main()
