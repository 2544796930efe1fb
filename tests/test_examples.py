"""The examples of the README run as printed."""

import re
from pathlib import Path

import torch

README = Path(__file__).parents[1] / "README.md"
FORMULATIONS = README.parent / "docs" / "formulations.md"
QUANTITIES = README.parent / "docs" / "quantities.md"


def test_the_code_of_the_readme_runs():
    """They give a gradient for every control step; some of it is more than rounding."""
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names: dict = {}
    exec(code, names)
    gradient = names["activation"].grad
    assert gradient.shape == (25, 1, 1) and bool(torch.isfinite(gradient).all())
    assert gradient.abs().max() > 1e-4 and bool((gradient != 0).all())


def test_the_code_on_contact_forces_runs():
    """A block on a belt presses with its weight and is pulled by the friction, whose derivative is the weight."""
    (code,) = re.findall(r"```python\n(.*?)```", FORMULATIONS.read_text(), re.DOTALL)
    names: dict = {}
    exec(code, names)
    pull, push = names["forces"].total[0, 0].tolist()
    assert abs(push / 588 - 1) < 0.1 and abs(pull / push / 0.3 - 1) < 1e-3
    assert abs(names["friction"].grad.item() / 588 - 1) < 0.15


def test_every_file_that_the_readme_names_is_there():
    """Links and pictures lead somewhere."""
    for target in re.findall(r"\]\(([^)#]+)\)", README.read_text()):
        if not target.startswith("http"):
            assert (README.parent / target).exists(), target


def test_the_code_on_quantities_runs():
    """A block that falls for 40 ms is 8 mm lower; a body that nothing holds is not strained."""
    (code,) = re.findall(r"```python\n(.*?)```", QUANTITIES.read_text(), re.DOTALL)
    names: dict = {}
    exec(code, names)
    model, end, softmpm = names["model"], names["end"], names["softmpm"]
    fallen = softmpm.body_mean(model, softmpm.displacement(model, end))[0, 0]
    assert abs(fallen[1].item() / (-9.8 * 100 * 101 / 2 * 4e-4**2) - 1) < 1e-4
    assert softmpm.von_mises_strain(end).max() < 1e-4
    frames = names["way"].frames
    assert frames.shape == (10, 1, 2)
    assert abs(frames[-1] - softmpm.center_of_mass(model, end, names["params"])).max() < 1e-6
