"""A process that judges plans, and may die or hang without ending the one that asks."""

import forked
import torch
import warp as wp

from fuzzing.judge import judge
from fuzzing.legal import judged
from fuzzing.scenes import Plan
from fuzzing.verdict import Verdict

PATIENCE = 120.0
"""Seconds after which a case hangs; the first of a kind compiles its kernels."""
PER_PROCESS = 250
"""Cases after which a process is replaced, so that what one of them broke does not last."""


def verdict_of(plan: Plan) -> Verdict:
    return judged(plan["seed"], plan["share"]) if plan["way"] == "legal" else judge(plan)


def serve(pipe) -> None:
    """Judge plans that come through a pipe."""
    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_ERROR
    while True:
        verdict = verdict_of(pipe.recv())
        pipe.send((verdict.kind, verdict.words))


class Worker:
    """Judges one plan after the other; replaces its process when that dies or hangs."""

    def __init__(self):
        self._process = None

    def _start(self) -> None:
        forked.ensure_server()
        self._pipe, theirs = forked.SERVER.Pipe()
        self._process = forked.SERVER.Process(target=serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()
        self._left = PER_PROCESS

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
            self._process = None

    def judge(self, plan: Plan) -> Verdict:
        if self._process is None:
            self._start()
        assert self._process is not None
        try:
            self._pipe.send(plan)
            if not self._pipe.poll(PATIENCE):
                self.stop()
                return Verdict("hang", f"no answer in {PATIENCE:.0f} s")
            verdict = Verdict(*self._pipe.recv())
        except (EOFError, ConnectionError):
            self._process.join()
            code = self._process.exitcode
            self.stop()
            return Verdict("crash", f"the process ended with {code}")
        self._left -= 1
        if self._left == 0:
            self.stop()
        return verdict
