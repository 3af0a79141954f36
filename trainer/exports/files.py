"""Files of an export: nothing is overwritten, and an error names the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO


class ExportError(ValueError):
    """An export that cannot be written; one line with the folder or file and the fix."""


def make_room(folder: Path) -> None:
    """Make a folder, unless it is there and empty. Raises ExportError where it is a file or holds something."""
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder}: is a file; name a folder with --out")
    if folder.is_dir() and any(folder.iterdir()):
        raise ExportError(f"{folder}: is not empty; nothing is overwritten, name a new folder with --out")
    folder.mkdir(parents=True, exist_ok=True)


@contextmanager
def new_file(path: Path) -> Iterator[TextIO]:
    """A text file that was not there before, with a line feed at the end of each line. Raises ExportError, OSError.

    Where anything fails before it is whole, it is removed.
    """
    try:
        file = path.open("x", encoding="utf-8", newline="")
    except FileExistsError:
        raise ExportError(f"{path}: exists already; nothing is overwritten, name a new file with --out") from None
    try:
        with naming(path), file:
            yield file
    except BaseException:  # Ctrl-C as well
        path.unlink(missing_ok=True)
        raise


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have an error name the file: a full disk names none."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
