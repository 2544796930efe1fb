import os
import signal

import pytest

from softmpm_learn.stop import stop_on_signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_second_ends(number):
    """One signal turns the wish on; another raises KeyboardInterrupt; afterwards the handlers are as before."""
    before = signal.getsignal(number)
    with stop_on_signals() as stop:
        assert not stop()
        os.kill(os.getpid(), number)
        assert stop()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


def test_several_signals_can_be_one_wish():
    """Without ``insist`` a second signal changes nothing: a launcher may pass one Ctrl-C on twice."""
    with stop_on_signals(insist=False) as stop:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
            assert stop()
