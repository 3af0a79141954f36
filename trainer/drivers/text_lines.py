"""Lines of a text table that may have been cut short."""

from __future__ import annotations

from pathlib import Path

from trainer import config
from trainer.config import ConfigError


def whole_lines(path: Path) -> list[str]:
    """The lines of a text file, without their ends.

    Raises ConfigError where it cannot be read, is empty, or ends within a line: cut in the middle of a number, a line
    would pass for a whole one.
    """
    text = config.read_text(path)
    if not text.strip():
        raise ConfigError(f"{path}: the file is empty")
    if not text.endswith("\n"):
        raise ConfigError(f"{path}: is cut short: its last line has no end; copy the file again, or end that line")
    return text.split("\n")[:-1]
