"""``python -m softmpm_learn``."""

from softmpm_learn.stop import Signals

if __name__ == "__main__":
    signals = Signals()
    signals.install()  # before the imports that take seconds

    from softmpm_learn.app import main

    main(signals)
