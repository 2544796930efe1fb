"""softmpm_learn: controller and body of a soft robot optimised together, through an observer that is learned during the optimisation.

``python -m softmpm_learn --help`` for experiments; :func:`softmpm_learn.train.train` for the loop in a program of one's own.
"""
