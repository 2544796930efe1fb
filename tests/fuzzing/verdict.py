"""Outcome of a case."""

import dataclasses

GOOD = ("ran", "refused", "named")
"""Ran through; refused with a ValueError or TypeError; stopped with an UnstableError."""
BAD = ("crash", "hang", "not finite", "silent", "unclear", "warned")
"""The process died; never ended; a result that is not finite; one that is wrong; an error that names nothing; a warning."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    kind: str
    words: str = ""

    @property
    def good(self) -> bool:
        return self.kind in GOOD
