"""A short round of the fault scripts, in a process of its own: it forks, and limits and kills what it forked."""

import os
from pathlib import Path

import forked
import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_short_round_of_all_fault_scripts():
    """Nothing hangs, is silently different, unclear, or written elsewhere; the whole round: ``python -m bench.faults``."""
    done = forked.python("-m", "bench.faults", "--share", "0.03", folder=ROOT, timeout=600.0)
    assert done.returncode == 0 and done.stdout.count(" 0 bad") == 4, done.stdout + done.stderr
