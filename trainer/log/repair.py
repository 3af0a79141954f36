"""Recordings that lack their end, since whoever wrote them was killed."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

#: How a whole file ends (rerun 0.41): where its footer lies, these letters, and how many footers there are.
MARK, COUNT_BYTES = b"RRF2FOOT", 4


def repair_command(recording: Path) -> str:
    """The one command that mends a recording; "" of one that is whole."""
    if _is_whole(recording):
        return ""
    good = recording.with_suffix(".repaired.rrd")
    return shlex.join([_rerun(), "rrd", "optimize", str(recording), "-o", str(good)])


def _is_whole(recording: Path) -> bool:
    try:
        with recording.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - len(MARK) - COUNT_BYTES))
            return file.read(len(MARK)) == MARK
    except OSError:  # it cannot be read here
        return False


def _rerun() -> str:
    """The program that belongs to this Python; its folder need not be on the user's PATH."""
    return shutil.which("rerun", path=str(Path(sys.executable).parent)) or "rerun"
