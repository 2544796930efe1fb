"""Fault injection: robustness of a run and its files. ``python -m bench.faults`` runs all scripts in full."""
