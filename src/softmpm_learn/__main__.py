"""``python -m softmpm_learn``, also installed as ``softmpm-learn``."""

import sys
from pathlib import Path

from softmpm_learn import plugins, register
from softmpm_learn.command.stop import Signals


def main() -> None:
    """Print the help at once, or import the program, which takes seconds, and run it with the files that the command line names."""
    files, words = plugins.split(sys.argv[1:])
    asked = bool({"--help", "-h"} & set(words))
    signals = Signals()
    signals.install()  # before the imports that take seconds
    if asked and not files and not plugins.has_packages():
        print(help_text())
        return

    from softmpm_learn.command import app

    sys.argv[1:] = words
    if asked:
        app.load(files)
        print(help_text())
    else:
        app.main(signals, files)


def help_text() -> str:
    """The template of ``conf/config.yaml``, from which Hydra would print the same."""
    from omegaconf import OmegaConf

    here = Path(__file__).resolve().parent
    places = (here / "conf" / "config.yaml", here.parents[1] / "conf" / "config.yaml")
    path = next(place for place in places if place.is_file())
    text, added = OmegaConf.load(path).hydra.help.template, register.added()
    return f"{text}\nRegistered by files and packages:\n\n{added}\n" if added else text


if __name__ == "__main__":
    main()
