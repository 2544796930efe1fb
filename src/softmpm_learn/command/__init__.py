"""From the command line to a finished folder: jobs of a sweep, experiments, seeds, pictures, and a sentence in place of a traceback."""
