"""Problems with exact answers, for bench/accuracy.py and the tests."""
