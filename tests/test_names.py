"""Names of softmpm that a test reads or replaces exist, also in tests that are skipped where there is no GPU."""

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

TESTS = Path(__file__).parent
OWNER = ModuleType | type


def imported(tree: ast.Module) -> Iterator[tuple[str, object]]:
    """Names that a file imports from softmpm and softmpm_learn, and what they are."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for name in node.names:
                if name.name in ("softmpm", "softmpm_learn"):
                    yield name.asname or name.name, importlib.import_module(name.name)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("softmpm"):
            for name in node.names:
                scope = {}
                exec(f"from {node.module} import {name.name} as found", scope)  # a submodule is imported, too
                yield name.asname or name.name, scope["found"]


def read(tree: ast.Module) -> Iterator[tuple[ast.expr, str, int]]:
    """Owner, name and line of each attribute that is read, and of each one that ``monkeypatch.setattr`` replaces."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            yield node.value, node.attr, node.lineno
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "monkeypatch.setattr":
            match node.args:
                case [owner, ast.Constant(value=str(name)), _]:
                    yield owner, name, node.lineno


def missing(path: Path) -> Iterator[str]:
    """Sentences on the names that do not exist."""
    tree = ast.parse(path.read_text())
    names = dict(imported(tree))

    def value(node: ast.expr) -> object:
        """The module or class that an expression is, None for anything else."""
        if isinstance(node, ast.Attribute):
            owner = value(node.value)
            found = getattr(owner, node.attr, None) if isinstance(owner, OWNER) else None
        else:
            found = names.get(node.id) if isinstance(node, ast.Name) else None
        return found if isinstance(found, OWNER) else None

    for owner, name, line in read(tree):
        of = value(owner)
        if not (of is None or hasattr(of, name) or name in getattr(of, "__annotations__", {})):
            yield f"{path.relative_to(TESTS)}, line {line}: {ast.unparse(owner)} has no {name}"


def test_names_exist():
    """In every file of the tests."""
    assert [sentence for path in sorted(TESTS.rglob("*.py")) for sentence in missing(path)] == []
