"""The book has an order: a module imports only modules that stand before it."""

import ast
import subprocess
import sys
from pathlib import Path

SRC = Path(__file__).parents[1] / "src"
ORDER = """kernels.turn validate scene state watch silhouette surface shapes checks check_scene reference stability alarms
    neighbours schedule horizon devices memory kernels.types kernels.spline kernels.polar kernels.elasticity
    kernels.muscle kernels.solid kernels.contact kernels.grid kernels.failure kernels.particle kernels.transfer
    kernels.boundary kernels.raster kernels.native kernels.stencil kernels.stencil_adj kernels.alarm kernels.fixed
    kernels.fused kernels.fused_adj kernels.sorting kernels.packing description model buffers explain failures step
    replay checkup plain between arrangement exact batches compiling program program_adj fast runner rollout raster
    autograd graph warp_arrays tape layout layout_checks superblock content playback recording_file recording
    appearance show rerun_file __main__""".split()
OUTSIDE = {
    "rerun": {"rerun_file"},
    "h5py": {"layout", "layout_checks", "playback", "recording_file", "recording"},
    "hydra": set(),
    "matplotlib": set(),
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
    found = {".".join(p.relative_to(root).with_suffix("").parts): p for p in sorted(root.rglob("*.py"))}
    return {name.removesuffix(".__init__"): path for name, path in found.items() if name != "__init__"}


def test_the_simulator_imports_in_one_direction():
    """Every module of softmpm has its place in ORDER, and imports only what stands before it."""
    found = modules("softmpm")
    for name, path in found.items():
        if name == "kernels":
            continue
        assert name in ORDER, f"{path} has no place in the order of the book"
        for imported in imports(path):
            inner = imported.removeprefix("softmpm.")
            if imported.startswith("softmpm.") and inner in ORDER:
                assert ORDER.index(inner) < ORDER.index(name), (
                    f"{name} imports {inner}, which stands after it"
                )


def test_one_module_per_outside_world():
    """Only recording says h5py and rerun; hydra and matplotlib have no place in the simulator; only autograd says autograd."""
    for name, path in modules("softmpm").items():
        roots = {imported.split(".")[0] for imported in imports(path)}
        for library, allowed in OUTSIDE.items():
            assert library not in roots or name in allowed, f"{name} imports {library}"
        if name not in ("autograd", "reference"):
            assert "torch.autograd" not in path.read_text(), name


def test_the_learner_uses_public_names_only():
    """softmpm_learn imports softmpm itself or what its __all__ names; only app says Hydra."""
    import softmpm

    for name, path in modules("softmpm_learn").items():
        for imported in imports(path):
            if imported.startswith("softmpm."):
                assert imported.removeprefix("softmpm.") in softmpm.__all__, f"{name} imports {imported}"
        if name not in ("app", "config", "__main__"):
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
    for path in (SRC / "softmpm" / "kernels").glob("*.py"):
        assert "from __future__" not in path.read_text(), path
