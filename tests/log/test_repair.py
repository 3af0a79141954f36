"""Which recordings lack their end, and what mends them."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from trainer.log.recovery import Interrupted
from trainer.log.repair import repair_command

#: The last bytes of a file of rerun 0.41 that `rerun rrd verify` accepts; tests of sinks hold it against whole files.
END = bytes.fromhex("326b690000000000b9cc010000000000e6ca5532") + b"RRF2FOOT\x01\0\0\0"


def test_a_whole_recording_needs_no_repair(tmp_path: Path) -> None:
    path = tmp_path / "whole.rrd"
    path.write_bytes(b"RRF2" + END)
    assert repair_command(path) == ""
    told = str(Interrupted("20261122-a", 100, 1.0, str(path)))
    assert told == (
        "session 20261122-a was interrupted: its first 1.00 s are kept, listed as aborted; its recording ends there"
    )


@pytest.mark.parametrize("content", [b"", b"RRF2", END[:-1], b"RRF2" + END + b"more"])
def test_one_without_its_end_is_mended_by_one_command(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "it's here.rrd"
    path.write_bytes(content)
    _, *what = shlex.split(repair_command(path))
    assert what == ["rrd", "optimize", str(path), "-o", str(tmp_path / "it's here.repaired.rrd")]
    told = str(Interrupted("20261122-a", 100, 1.0, str(path)))
    assert told.endswith(f"; its recording lacks its end, repair it with: {repair_command(path)}")


def test_without_a_recording_none_is_told_of(tmp_path: Path) -> None:
    for recording in (None, str(tmp_path / "gone.rrd")):
        assert str(Interrupted("20261122-a", 100, 1.0, recording)).endswith("listed as aborted")
