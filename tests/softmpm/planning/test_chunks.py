"""Chunks cover a call once, in order, and chunks that do the same have the same shape."""

import itertools

import pytest

from softmpm.planning.chunks import Horizon


@pytest.mark.parametrize(
    "control_steps, substeps, longest", list(itertools.product((1, 3, 7), (1, 5, 64, 100), (1, 8, 64)))
)
def test_chunks_cover_the_call(control_steps, substeps, longest):
    """Every substep is in one chunk, none is too long, and each knows which control steps it touches."""
    horizon = Horizon(control_steps, substeps)
    chunks = horizon.chunks(longest)
    assert [s for c in chunks for s in range(c.first, c.first + c.length)] == list(range(horizon.total))
    assert max(c.length for c in chunks) <= longest
    count, lengths = horizon.counted(longest)
    assert count == len(chunks) and sorted(lengths) == sorted(n for n, _ in {c.shape for c in chunks})
    for chunk in chunks:
        steps = [(chunk.first + s) // substeps for s in range(chunk.length)]
        assert [chunk.rows.start + chunk.row(s) for s in range(chunk.length)] == steps
        assert chunk.rows.stop == steps[-1] + 1
        begins = tuple(s for s in range(1, chunk.length) if steps[s] != steps[s - 1])
        assert chunk.shape == (chunk.length, begins)


def test_few_shapes():
    """A thousand substeps in one control step, or in many, make at most two shapes: one of the last chunk."""
    for horizon in (Horizon(1, 1000), Horizon(40, 25), Horizon(4, 250)):
        assert len({chunk.shape for chunk in horizon.chunks(128)}) <= 2
