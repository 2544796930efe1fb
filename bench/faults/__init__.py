"""Fault scripts: what a run and its files survive. ``python -m bench.faults`` runs the full round of all of them."""
