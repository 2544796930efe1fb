"""softmpm_learn: controller and body of a soft robot optimised together, through an observer that is learned during the optimisation.

``python -m softmpm_learn --help`` for experiments; :mod:`softmpm_learn.register` for robots, observers and policies of one's own;
:func:`softmpm_learn.train.train` for the loop in a program of one's own.
"""

from softmpm_learn import register


def main() -> None:
    """The command line, from a program that registers its own: ``if __name__ == "__main__": softmpm_learn.main()``."""
    from softmpm_learn.__main__ import main as run

    run()


__all__ = ["main", "register"]
