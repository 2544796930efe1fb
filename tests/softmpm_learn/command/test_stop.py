"""Signals: in a process of its own, because they end it."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from softmpm_learn.command.stop import SIGNALS, Signals

SOURCE = Path(__file__).parents[3] / "src"
CODE = f"""
import os, signal, sys
sys.path.insert(0, {str(SOURCE)!r})
from softmpm_learn.command.stop import Signals
number, signals = int(sys.argv[1]), Signals()
signals.install()
kill = lambda: os.kill(os.getpid(), number)
class Finalizer:
    def __del__(self):
        kill()
"""


def ended(number: int, code: str) -> tuple[int, str]:
    """Exit code and stderr of a process that sends itself signals."""
    command = [sys.executable, "-c", CODE + code, str(number)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stderr


@pytest.fixture
def installed():
    """Both signals belong to a new object; afterwards the handlers are as before."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    signals = Signals()
    signals.install()
    yield signals
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_asks_and_the_second_ends(number):
    """While a run is awaited one signal is a wish; another ends the process, with what was saved."""
    code, said = ended(
        number,
        """
with signals.awaited() as stop:
    assert not stop()
    kill()
    assert stop()
    signals.advice = "All is saved."
    kill()
print("not ended", file=sys.stderr)
""",
    )
    assert code == 128 + number and said == "softmpm_learn: interrupted. All is saved.\n"


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("where", ["kill()", "Finalizer()", "with signals.awaited(): pass\nkill()"])
def test_elsewhere_the_first_one_ends(number, where):
    """At start-up and while pictures are drawn, also inside a finalizer, where Python would print an exception and go on."""
    code, said = ended(number, f"{where}\nprint('not ended', file=sys.stderr)")
    assert code == 128 + number
    assert said == "softmpm_learn: interrupted. No iteration had begun, so nothing is lost.\n"


def test_several_signals_can_be_one_wish(installed):
    """Without ``insist`` a second signal changes nothing: a launcher may pass one Ctrl-C on twice."""
    with installed.awaited(insist=False) as stop:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
            assert stop()
