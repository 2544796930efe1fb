"""softmpm_learn: controller and body of a soft robot optimised together, through what it learns to see on the way.

``python -m softmpm_learn --help`` for experiments; :func:`softmpm_learn.train.train` for the loop in a program of one's own.
"""
