"""Files and installed packages that register robots, observers, policies and optimisers when they are imported.

Only what the command line names is imported, and entry points of the group ``softmpm_learn``; never what a run's folder names.
"""

import hashlib
import importlib.util
import re
import sys
import traceback
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from softmpm_learn.register import GROUP, TABLES

loaded: list[Path] = []
"""Files that were imported, in their order."""
_loading: list[Path] = []
_packages: set[str] = set()


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Files among the words of a command line, which end in .py, and the other words."""
    files = [word for word in words if word.endswith(".py") and "=" not in word]
    return files, [word for word in words if word not in files]


def load(path: str | Path) -> ModuleType | None:
    """Import a file; its folder can be imported from, too.

    Raises:
        ValueError: There is none, or it raises; names file, line and reason.
    """
    path = Path(path).resolve()
    if path in loaded:
        return None
    if not path.is_file():
        raise ValueError(f"there is no file {path}.")
    name = f"softmpm_learn_file_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    sys.modules[name] = module
    _loading.append(path)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise ValueError(f"{path}{_line(error, path)}: {type(error).__name__}: {error}") from error
    finally:
        _loading.pop()
    loaded.append(path)
    return module


def has_packages() -> bool:
    """True if installed packages have entry points."""
    return bool(entry_points(group=GROUP))


def load_packages() -> None:
    """Import the entry points of installed packages, each once.

    Raises:
        ValueError: One raises; names it.
    """
    for point in entry_points(group=GROUP):
        if point.value in _packages:
            continue
        try:
            point.load()
        except Exception as error:
            raise ValueError(
                f"the entry point {point.name} = {point.value!r} of an installed package cannot be imported: "
                f"{type(error).__name__}: {error}"
            ) from error
        _packages.add(point.value)


def need_complete() -> None:
    """Raise ValueError while a file is being imported: it would begin a run before all of it is there."""
    if _loading:
        raise ValueError(
            f'{_loading[-1]} calls softmpm_learn.main() when it is imported; write if __name__ == "__main__": before the call.'
        )


def files() -> list[str]:
    """Files that registered something, the program itself among them if it did."""
    found = [str(path) for path in loaded]
    program = getattr(sys.modules.get("__main__"), "__file__", None)
    if program and _program_registers():
        found.append(str(Path(program).resolve()))
    return found


def command(names: Sequence[str] | None = None) -> str:
    """Beginning of the command line that has these files, by default those of this process."""
    if names is None and not loaded and (own := files()):
        return f"python {_short(own[0])}"
    return " ".join(["python -m softmpm_learn", *map(_short, loaded if names is None else names)])


def resume(folder: str | Path) -> str:
    """Argument that continues the run in a folder, as a shell takes it. Hydra reads spaces, brackets and letters with accents only
    within quotes of its own."""
    if re.fullmatch(r"[\w./\\:+-]+", str(folder), re.ASCII):
        return f"resume={folder}"
    quoted = str(folder).replace("'", r"\'")
    return f"\"resume='{quoted}'\""


def _program_registers() -> bool:
    return any(table[name].build.__module__ == "__main__" for table in TABLES for name in table.added)


def _short(path: str | Path) -> str:
    """Relative to here if it lies below."""
    path = Path(path)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def _line(error: Exception, path: Path) -> str:
    """The last line of the file that the error came through."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f", line {error.lineno}"
    lines = [
        frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)
    ]
    return f", line {lines[-1]}" if lines else ""
