"""``python -m softmpm_learn``."""

from softmpm_learn.app import main

if __name__ == "__main__":
    main()
