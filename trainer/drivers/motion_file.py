"""Recorded motion from any file that we can read; which reader, its name's end says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from trainer.config import ConfigError
from trainer.drivers import jigsaws, perktutor, pose_table, sequence_file, sequence_nrrd
from trainer.motion import Motion

#: By the end of the file's name: how to read it.
READERS: dict[str, Callable[[str | Path], Motion]] = {
    ".mha": sequence_file.read,
    ".nrrd": sequence_nrrd.read,
    ".txt": jigsaws.read,
    ".xml": perktutor.read,
    ".csv": pose_table.read,
}


def read(path: str | Path) -> Motion:
    """The recording in a file. Raises ConfigError, one line, where it cannot be read or is of no known kind."""
    reader = READERS.get(Path(path).suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: no recording; expected a name that ends in {', '.join(READERS)}")
    return reader(path)
