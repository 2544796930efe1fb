"""All fault-injection scripts: ``python -m bench.faults [--share 0.1]``."""

from bench.faults import common, corruption, flips, hostile, kills

if __name__ == "__main__":
    common.report(flips.main, hostile.main, corruption.main, kills.main)
