"""The layers of the simulator and of the learner: a module imports only from layers above its own."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import softmpm

SRC = Path(__file__).parents[1] / "src"
LAYERS = """
    validate summary draft devices batches compiling workspace kernels.compile
    state inputs kernels.parts kernels.dependent
    errors
    scene planning alarms kernels.structs
    checks
    check_inputs check_state
    energy_density oracle.stress oracle.transfer oracle.walls
    oracle.moving oracle.step_limit kernels.physics check_nodes
    oracle.contact oracle.driven oracle.overlap oracle.mirror
    stability kernels.convert oracle.lagrangian oracle.moving_contact
    kernels.material kernels.rasterize kernels.plain kernels.fast kernels.lagrangian
    kernels.carried
    rest_grid
    surface_points
    surface_grid mirror_grid overlap_grid
    driven_grid
    describe specification
    model
    schemes wall_poses
    schemes.plain schemes.fast schemes.lagrangian recording
    schemes.registry material
    kernel_inputs choices
    building runner rasterization cuda_graph
    rollout forces quantities warp_nodal
    autograd warp_particles pictures
    warp_arrays trajectories
    warp_api __main__
"""
"""From the ground up. Each word is a module or a package; those of one line do not import each other."""
LEARNER_LAYERS = """
    distributed seeding modes unchanged likeness setting_checks storage autoencoder fading
    term
    objective
    lasting
    tasks.task figures
    register
    plugins optimizer_settings tasks loggers
    settings optimizers
    config design observe policy recovery
    observer_check
    episode learning gym
    runs
    training
    train
    command
    __main__
"""
ENTRIES = {"schemes.plain.chunk", "schemes.fast.scheme", "schemes.lagrangian.scheme"}
"""Module of each scheme that the registry imports."""
KNOWN = {
    "schemes.registry": ENTRIES,
    "autograd": {"schemes.lagrangian.nodal"},
    "kernel_inputs": {"schemes.lagrangian.driven"},
    "quantities": {"schemes.lagrangian.nodal"},
    "warp_api": {"schemes.lagrangian.nodal_step"},
    "warp_arrays": {
        "schemes.lagrangian.nodal",
        "schemes.lagrangian.nodal_step",
        "schemes.plain.particle_step",
    },
    "warp_particles": {"schemes.plain.substep"},
}
"""Modules of schemes that others import."""
OUTSIDE = {
    "rerun": {f"recording.rerun_{name}" for name in ("export", "blueprint", "walls")},
    "h5py": {f"recording.{name}" for name in ("format", "format_checks", "reader", "file", "writer")},
    "hydra": set(),
    "matplotlib": {"pictures.figure", "pictures.film", "pictures.panel"},
}


def imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def modules(package: str) -> dict[str, Path]:
    root = SRC / package
    paths = (path for path in sorted(root.rglob("*.py")) if path.name != "__init__.py")
    return {".".join(path.relative_to(root).with_suffix("").parts): path for path in paths}


def layer_of(module: str, layers: str = LAYERS) -> tuple[int, str]:
    """Line of a module in these layers, and its word there: the longest one that it stands under."""
    lines = [line.split() for line in layers.strip().splitlines()]
    found = [
        (len(word), line, word)
        for line, words in enumerate(lines)
        for word in words
        if module == word or module.startswith(f"{word}.")
    ]
    assert found, f"{module} has no layer"
    _, line, word = max(found)
    return line, word


def arrows(package: str) -> dict[str, set[str]]:
    """Modules and packages of a package that each of its modules imports."""
    found = modules(package)
    known = {".".join(name.split(".")[:depth]) for name in found for depth in range(1, name.count(".") + 2)}
    inner = {name: {i.removeprefix(f"{package}.") for i in imports(path)} for name, path in found.items()}
    return {
        name: {i for i in names & known if not _leads_to(i, names & known)} for name, names in inner.items()
    }


def _leads_to(package: str, names: set[str]) -> bool:
    """True for the package in ``from package import module``."""
    return any(name.startswith(f"{package}.") for name in names)


@pytest.mark.parametrize(("package", "layers"), [("softmpm", LAYERS), ("softmpm_learn", LEARNER_LAYERS)])
def test_imports_go_in_one_direction(package, layers):
    """Every module has a layer and imports only from those above, or from its own package without a circle."""
    within = {}
    for name, imported in arrows(package).items():
        own, word = layer_of(name, layers)
        for other in imported:
            line, their = layer_of(other, layers)
            assert line < own or their == word, f"{name} imports {other}, which is not above it"
        within[name] = {other for other in imported if layer_of(other, layers)[1] == word}
    graphlib.TopologicalSorter(within).prepare()  # raises CycleError


def test_nothing_above_the_schemes_knows_one():
    """Whoever drives a scheme imports the interface and the registry. The Warp-native API launches substeps itself; states with nodes
    and the velocities of driven nodes belong to a call, not to a chunk."""
    schemes = {scheme.rpartition(".")[0] for scheme in ENTRIES}
    for name, imported in arrows("softmpm").items():
        inside = {
            other for other in imported if other.rpartition(".")[0] in schemes - {name.rpartition(".")[0]}
        }
        assert inside <= KNOWN.get(name, set()), f"{name} imports {', '.join(inside)}"


def test_docstrings_name_a_thing_or_an_act():
    """No first line begins with What, Whether, Where or How."""
    for path in sorted(SRC.rglob("*.py")):
        found = re.findall(r'"""(?:What|Whether|Where|How)\b.*', path.read_text())
        assert not found, f"{path.name}: {found[0]}"


def test_only_public_names_show():
    """``dir(softmpm)`` is its public names, and none of them is also that of a module."""
    assert dir(softmpm) == sorted(softmpm.__all__)
    assert not set(softmpm.__all__) & {name.split(".")[0] for name in modules("softmpm")}


def test_one_module_per_outside_world():
    """Only recording says h5py and rerun, only pictures says matplotlib; hydra has no place here; own gradients say autograd."""
    for name, path in modules("softmpm").items():
        roots = {imported.split(".")[0] for imported in imports(path)}
        for library, allowed in OUTSIDE.items():
            assert library not in roots or name in allowed, f"{name} imports {library}"
        own = (
            "autograd",
            "batches",
            "energy_density",
            "oracle.moving",
            "oracle.step_limit",
            "oracle.stress",
        )
        if name not in own:
            assert "torch.autograd" not in path.read_text(), name


def test_the_learner_uses_public_names_only():
    """softmpm_learn imports softmpm itself or what its __all__ names; only the command line says Hydra."""
    for name, path in modules("softmpm_learn").items():
        for imported in imports(path):
            if imported.startswith("softmpm."):
                assert imported.removeprefix("softmpm.") in softmpm.__all__, f"{name} imports {imported}"
        if name not in ("command.app", "command.sentences", "config", "__main__"):
            assert "hydra" not in {imported.split(".")[0] for imported in imports(path)}, name


def test_importing_the_simulator_is_light():
    """``import softmpm`` loads neither rerun, hydra nor matplotlib nor PyTorch's compiler, and has no side effect on Warp."""
    code = (
        "import sys, torch\n"
        "before = 'torch._dynamo' in sys.modules\n"
        "import softmpm, warp as wp\n"
        "assert ('torch._dynamo' in sys.modules) == before\n"
        "heavy = {'rerun', 'hydra', 'matplotlib', 'trimesh'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "assert wp._src.context.runtime is None"
    )
    subprocess.run(
        [sys.executable, "-c", code], check=True, env={"PYTHONPATH": str(SRC), "PATH": ""}, timeout=120
    )


def test_kernel_files_do_not_postpone_annotations():
    """``from __future__ import annotations`` would hide a factory's local types from Warp."""
    for path in (SRC / "softmpm" / "kernels").rglob("*.py"):
        assert "from __future__" not in path.read_text(), path


DEFINITION = re.compile(r"  \(([A-Z]\d+)\)(?:  |$)", re.MULTILINE)
"""A formula's label stands apart from it, at the end of its line."""


def test_labels_lead_to_one_formula():
    """No two pages of docs/math define the same label, nor both packages; and every label in the code is defined, those of kernels and
    of the oracle on the pages, but for kernels in C."""
    defined = {}
    for path in [*(SRC.parent / "docs" / "math").glob("*.md"), *(SRC / "softmpm_learn").rglob("*.py")]:
        for label in DEFINITION.findall(path.read_text()):
            assert label not in defined, f"({label}) stands in {defined[label]} and in {path}"
            defined[label] = path
    source = [path for kind in ("*.py", "*.h") for path in (SRC / "softmpm").rglob(kind)]
    apart = (path for path in source if path.suffix == ".h" or not {"kernels", "oracle"} & set(path.parts))
    for path in apart:
        for label in DEFINITION.findall(path.read_text()):
            assert "softmpm_learn" not in str(defined.setdefault(label, path)), (
                f"({label}) of {path} is the learner's"
            )
    for path in [*source, *(SRC / "softmpm_learn").rglob("*.py")]:
        for label in re.findall(r"\(([A-Z]\d+)(?:\.\w+)?\)", path.read_text()):
            assert label in defined, f"({label}) in {path} leads nowhere"
