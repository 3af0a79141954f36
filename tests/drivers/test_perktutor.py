"""PerkTutor's transform logs: devices recorded by turns come onto one clock, and their motion stays what it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.drivers.format_samples import perktutor as written
from tests.drivers.format_samples import pose, put
from trainer.config import ConfigError
from trainer.drivers import open_profile, perktutor
from trainer.drivers.recording import neighbours, resample
from trainer.geometry import matrix_from_quaternion, slerp
from trainer.motion import Motion


def test_seconds_and_nanoseconds_make_the_clock(tmp_path: Path) -> None:
    """The second passes from 7 to 8 between the first samples; messages are passed by."""
    motion = perktutor.read(put(tmp_path, ".xml", written(3)))
    np.testing.assert_allclose(motion.time, 7.99 + 0.01 * np.arange(6), rtol=0, atol=1e-12)
    assert motion.sensors == ["Stylus", "Needle"]


def test_a_device_is_seen_from_its_first_to_its_last_sample_and_between_them_on_the_way(tmp_path: Path) -> None:
    """Needle's samples lie half an interval after Stylus's: there Stylus has gone half of 1 mm, half of 0.1 rad.

    The file holds 9 digits.
    """
    motion = perktutor.read(put(tmp_path, ".xml", written(3)))
    stylus, needle = motion.track("Stylus"), motion.track("Needle")
    assert stylus.ok.tolist() == [True, True, True, True, True, False]
    assert needle.ok.tolist() == [False, True, True, True, True, True]
    wanted = [[pose(k)[i][3] for i in range(3)] for k in (0, 0.5, 1, 1.5, 2)]
    np.testing.assert_allclose(stylus.position[:5], wanted, rtol=0, atol=1e-8)
    turned = np.array(pose(1.5))[:3, :3]  # type: ignore[arg-type]
    np.testing.assert_allclose(matrix_from_quaternion(stylus.quaternion[3]), turned, rtol=0, atol=1e-8)


def test_what_is_resampled_is_what_the_device_s_own_samples_give(tmp_path: Path) -> None:
    """Parts of a straight line and of a great circle are straight and great: 1e-12 for a dozen roundings of 1e-15."""
    motion = perktutor.read(put(tmp_path, ".xml", written(9)))
    track = motion.track("Needle")
    own = np.flatnonzero(np.arange(18) % 2 == 1)
    alone = Motion("own", motion.time[own], np.arange(9), {})
    time = np.linspace(0.0, alone.duration_s, 57)
    before, after, f = neighbours(alone.time, time)
    p, q = track.position[own], track.quaternion[own]
    late = time + (alone.time[0] - motion.time[0])
    position, quaternion, ok = resample(motion, track, late, 100.0)
    np.testing.assert_allclose(position, (1 - f[:, None]) * p[before] + f[:, None] * p[after], rtol=0, atol=1e-10)
    np.testing.assert_allclose(quaternion, slerp(q[before], q[after], f), rtol=0, atol=1e-10)
    assert ok[1:-1].all()


def test_the_older_spelling_of_time_is_read(tmp_path: Path) -> None:
    log = '<log time="{}" type="transform" DeviceName="A" transform="1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1"/>'
    text = f"<TransformRecorderLog>{log.format(1.5, 0)}{log.format(1.75, 1)}</TransformRecorderLog>"
    assert perktutor.read(put(tmp_path, ".xml", text.encode())).time.tolist() == [1.5, 1.75]


def test_devices_have_no_usual_names_so_a_profile_must_say_which_moves_what(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"which of its sensors \(.+\) moves what\? Write a profile"):
        open_profile(str(put(tmp_path, ".xml", written())))


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (b"</TransformRecorderLog>", b"", "is cut short or no XML: line"),
        (b'TimeStampNSec="10000000"', b"", "transform 3: 'TimeStampNSec' expected 1 numbers, found ''"),
        (b'Sec="8" TimeStampNSec="10000000"', b'Sec="6" TimeStampNSec="1"', "transform 3: time goes back from 7.99"),
        (b' 3 0 0 0 1 "', b' 3 0 0 0 "', "transform 1: 'transform' expected 16 numbers"),
        (b' 3 0 0 0 1 "', b' inf 0 0 0 1 "', "transform 1: 'transform' expected 16 numbers"),
        (b' 3 0 0 0 1 "', b' 3 0 0 5 1 "', "transform 1: that of 'StylusToReference' is not a rotation"),
        (b"transform", b"message", "holds no transform"),
    ],
)
def test_a_bad_log_is_one_line(tmp_path: Path, old: bytes, new: bytes, complaint: str) -> None:
    content = written()
    changed = content.replace(old, new) if old == b"transform" else content.replace(old, new, 1)
    assert changed != content
    with pytest.raises(ConfigError, match=complaint):
        perktutor.read(put(tmp_path, ".xml", changed))


@pytest.mark.parametrize("encoding", ["foo", "gb2312"])
def test_an_encoding_that_cannot_be_read_is_one_line(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "log.xml"
    path.write_text(f'<?xml version="1.0" encoding="{encoding}"?>\n<TransformRecorderLog/>\n')
    with pytest.raises(ConfigError, match=r"log.xml: its encoding cannot be read: .*; save it as UTF-8"):
        perktutor.read(path)
