"""``trainer export``: sessions and recordings as files that are read again, and that overwrite nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import CommandLine
from tests.drivers.format_samples import FRAMES, SAMPLES, put
from tests.log import log_samples
from trainer.drivers import motion_file
from trainer.log import reader
from trainer.poses import ToolPoses

SAMPLED = log_samples.poses


def turned(tick: int) -> ToolPoses:
    """The samples' poses, with quaternions of length 1."""
    poses = SAMPLED(tick)
    return replace(poses, quaternion=poses.quaternion / np.linalg.norm(poses.quaternion, axis=1, keepdims=True))


def test_each_session_becomes_a_sequence_file(
    command_line: CommandLine, own_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_samples, "poses", turned)
    for session in ("20260101-a", "20260102-b"):
        log_samples.write(own_log, session)
    code, out, err = command_line("export", "igs-mha", "--out", tmp_path / "out", "--json")
    assert (code, err) == (0, "")
    frames = json.loads(out)["frames"]
    assert list(frames) == ["20260101-a.igs.mha", "20260102-b.igs.mha"]
    with reader.open_log(own_log) as log:
        record = reader.load(log, "20260101-a")
    motion = motion_file.read(tmp_path / "out" / "20260101-a.igs.mha")
    assert len(motion.time) == frames["20260101-a.igs.mha"] == len(record.position)
    for k, tool in enumerate(record.header.tools):
        ok = record.valid[:, k]
        np.testing.assert_array_equal(motion.track(tool).position[ok], record.position[ok, k])
        np.testing.assert_array_equal(motion.track(tool).quaternion[ok], record.quaternion[ok, k])


def test_an_empty_log_and_a_full_folder_are_one_line(command_line: CommandLine, own_log: Path, tmp_path: Path) -> None:
    log_samples.write(own_log, "20260101-a")
    code, _, err = command_line("export", "igs-mha", "--out", tmp_path / "out", "--trainee", "nobody")
    assert (code, err.count("\n")) == (1, 1)
    code, _, err = command_line("export", "igs-mha", "--out", tmp_path)
    assert (code, err.count("\n")) == (1, 1)
    assert "is not empty; nothing is overwritten" in err


@pytest.mark.parametrize("end", [".igs.mha", ".csv"])
@pytest.mark.parametrize("start", SAMPLES)
def test_a_recording_of_any_format_is_written_again(
    command_line: CommandLine, tmp_path: Path, start: str, end: str
) -> None:
    content, sensor = SAMPLES[start]
    out = tmp_path / f"again{end}"
    code, _, err = command_line("export", "recording", put(tmp_path, start, content), "--out", out)
    assert (code, err) == (0, "")
    assert motion_file.read(out).track(sensor).ok.sum() >= FRAMES


def test_a_name_of_another_format_is_refused(command_line: CommandLine, tmp_path: Path) -> None:
    path = put(tmp_path, ".csv", SAMPLES[".csv"][0])
    code, out, err = command_line("export", "recording", path, "--out", tmp_path / "a.bag")
    assert (code, out) == (1, "")
    assert "a.bag: no format for this; give --out a name that ends in .igs.mha or .csv" in err
