"""Every law, actuator and input stands in all tables that docs/extending.md names, so that one that is forgotten is named."""

from pathlib import Path

import pytest
from helpers import GIVEN, LAWS, WALL_INPUTS

import softmpm
from softmpm import energy_density
from softmpm.inputs import Input, Inputs
from softmpm.oracle import step_limit, stress
from softmpm.scene import file
from softmpm.scene.actuators import Actuator
from softmpm.scene.materials import Material
from softmpm_learn.tasks import task

KERNELS = Path(softmpm.__file__).parent / "kernels" / "physics"


def kernel_files(folder: str) -> set[str]:
    return {path.stem for path in (KERNELS / folder).glob("*.py")} - {"__init__"}


def snake(name: str) -> str:
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name).strip("_")


def public(base: type) -> set[type]:
    """Subclasses under their public names; a class with slots has a second one that nothing refers to."""
    return {getattr(softmpm, kind.__name__) for kind in base.__subclasses__()}


def test_laws():
    """Oracle, energy, energy for the step limit, file of scenes, kernels and tests have the same laws."""
    laws = public(Material)
    names = {snake(law.__name__): law for law in laws}
    tables = {
        "LAWS of tests/helpers.py": set(LAWS.values()),
        "LAWS of softmpm/oracle/stress.py": set(stress.LAWS),
        "DENSITIES of softmpm/energy_density.py": set(energy_density.DENSITIES),
        "ENERGIES of softmpm/oracle/step_limit.py": set(step_limit.ENERGIES),
        "TYPES of softmpm/scene/file.py": laws & set(file.TYPES.values()),
        "LAWS of softmpm_learn/tasks/task.py": set(task.LAWS.values()),
        "files of softmpm/kernels/physics/laws": {names.get(name, name) for name in kernel_files("laws")},
    }
    for table, found in tables.items():
        assert found == laws, f"the {table} lack or have too many: {found ^ laws}"
    assert names == LAWS == task.LAWS


def test_actuators():
    """Oracle, step limit, file of scenes and kernels have the same kinds."""
    kinds = public(Actuator)
    assert kinds == set(stress.ACTUATORS) == set(step_limit.STIFFENING)
    assert kinds <= set(file.TYPES.values())
    assert kernel_files("actuators") == {snake(kind.__name__) for kind in kinds}


def test_inputs():
    """test_inputs.py and test_lagrangian.py compare each of them: what a formulation did not read would have no gradient there."""
    assert {*GIVEN, *WALL_INPUTS} == set(Inputs._fields) - {"strength", "velocity", "position"}


def test_an_input_that_would_be_bound_wrongly_is_refused():
    """Scalars of particles have no rows, vectors must have them."""
    for kind, rows in (("scalar", True), ("index", True), ("vector", False)):
        with pytest.raises(ValueError, match=f"input 'charge'.*got kind='{kind}' and rows={rows}"):
            Input(name="charge", per="particle", kind=kind, rows=rows)
