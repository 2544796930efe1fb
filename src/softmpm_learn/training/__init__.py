"""The parts of an iteration and of a run's end: optimisation, evaluation, examination, and the files that record them."""
