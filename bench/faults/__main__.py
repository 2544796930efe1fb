"""All fault scripts: ``python -m bench.faults [--short]``."""

import sys

from bench.faults import common, corruption, flips, hostile, kills


def main(share: float = 1.0) -> list[common.Table]:
    """The whole round of each, or a share of it."""
    return [script.main(share) for script in (flips, hostile, corruption, kills)]


if __name__ == "__main__":
    tables = main(0.1 if "--short" in sys.argv else 1.0)
    print(*tables, sep="\n\n")
    raise SystemExit(1 if any(table.failures for table in tables) else 0)
