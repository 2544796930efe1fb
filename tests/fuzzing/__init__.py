"""Random scenes, states and calls, and what softmpm made of each; run by tests/softmpm/test_fuzz.py and bench/fuzz.py."""
