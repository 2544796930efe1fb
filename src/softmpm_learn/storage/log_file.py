"""The log file of a run, begun once its folder is locked."""

import contextlib
import logging
import logging.handlers
from collections.abc import Callable, Iterator
from pathlib import Path

from softmpm_learn.storage import files


class _LogFile(logging.FileHandler):
    """A log file that cannot be written ends the run, as any other file does."""

    def handleError(self, record: logging.LogRecord) -> None:
        with files.named("write", Path(self.baseFilename)):
            raise


@contextlib.contextmanager
def log_file() -> Iterator[Callable[[Path], None]]:
    """Gives a function that begins the log file; what was logged before it is called, while the folder may be another's, follows."""
    root = logging.getLogger()
    early = logging.handlers.MemoryHandler(10**6, flushLevel=logging.CRITICAL + 1, flushOnClose=False)
    root.addHandler(early)

    def begin(path: Path) -> None:
        before = files.read(path) if path.exists() else b""
        files.replace(path, before)  # a file of its own, whatever else had its name
        early.setTarget(_LogFile(path, encoding="utf-8"))
        early.flush()
        early.flushLevel = logging.NOTSET

    try:
        yield begin
    finally:
        root.removeHandler(early)
        if early.target is not None:
            early.target.close()
        early.close()
