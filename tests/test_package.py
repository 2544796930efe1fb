"""The installed package has types, a version, and no dependency that nothing imports."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

import softmpm

ROOT = Path(__file__).parents[1]
IMPORTED_AS = {
    "warp-lang": "warp",
    "rerun-sdk": "rerun",
    "hydra-core": "hydra",
    "pillow": "PIL",
    "imageio-ffmpeg": "imageio_ffmpeg",
    "charset-normalizer": "trimesh",
    "stable-baselines3": "stable_baselines3",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, check=True, cwd=ROOT, capture_output=True, timeout=300)
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


def test_types_are_shipped(wheel):
    """Both packages are marked as typed, so that mypy checks their types."""
    assert {"softmpm/py.typed", "softmpm_learn/py.typed"} <= set(wheel.namelist())


def test_the_version_is_that_of_the_wheel(wheel):
    """One number, in one place."""
    (metadata,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    assert f"\nVersion: {softmpm.__version__}\n" in wheel.read(metadata).decode()
    assert re.fullmatch(r"\d+\.\d+\.\d+", softmpm.__version__)


def test_the_learner_is_a_command(wheel):
    """The installed command is the entry of ``python -m softmpm_learn``."""
    (name,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "softmpm-learn = softmpm_learn.__main__:main" in wheel.read(name).decode()
    assert callable(importlib.import_module("softmpm_learn.__main__").main)


def test_the_citation_has_the_version():
    """And the authors of the metadata."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert citation["version"] == softmpm.__version__
    assert [one["name"] for one in citation["authors"]] == [one["name"] for one in project["authors"]]
    assert citation["license"] == project["license"]


def test_everything_that_is_installed_is_imported():
    """By a module of src: a dependency or extra that nothing uses promises what is not there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {
        name: asked for name, asked in project["optional-dependencies"].items() if name not in ("dev", "docs")
    }
    imported = set()
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.split(".")[0])
    for requirement in [*project["dependencies"], *(one for asked in extras.values() for one in asked)]:
        name = re.match(r"[\w-]+", requirement)[0]
        assert IMPORTED_AS.get(name, name) in imported, requirement
