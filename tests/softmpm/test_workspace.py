"""Buffers cached for later calls are stored by key and thread, and freed on request."""

import threading

from helpers import busy_scene

import softmpm
from softmpm.workspace import Workspace


def test_objects_are_made_once_per_thread_and_key():
    """Another thread gets an object of its own."""
    workspace, made = Workspace(), []

    def make() -> object:
        made.append(object())
        return made[-1]

    first = workspace.get("a", make)
    assert workspace.get("a", make) is first and workspace.get("b", make) is not first
    other = threading.Thread(target=workspace.get, args=("a", make))
    other.start()
    other.join()
    assert len(made) == 3
    workspace.release()
    assert workspace.get("a", make) is not first


def test_a_call_leaves_its_scheme_in_the_workspace_and_nothing_else():
    """A model's attributes are the same before and after a call."""
    model = softmpm.build(busy_scene(2), device="cpu")
    _ = model.budget, model.held_nodes  # computed on first use
    before = {name: id(value) for name, value in vars(model).items()}
    softmpm.simulate(model, model.rest(), None, model.params(), substeps=2)
    assert {name: id(value) for name, value in vars(model).items()} == before
