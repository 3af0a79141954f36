"""JIGSAWS kinematics: columns, units and jaws are those of the format's description."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.drivers.format_samples import jigsaws as written
from tests.drivers.format_samples import pose, put
from trainer.config import ConfigError
from trainer.drivers import jigsaws, open_profile
from trainer.drivers.recording import resample_jaws


def test_each_manipulator_has_its_own_columns_in_mm_and_rad(tmp_path: Path) -> None:
    """The file holds 8 significant digits: 5e-8 of 32 mm and of an angle of 1 rad."""
    motion = jigsaws.read(put(tmp_path, ".txt", written(7)))
    assert motion.sensors == ["MasterLeft", "MasterRight", "SlaveLeft", "SlaveRight"]
    np.testing.assert_allclose(motion.time, np.arange(7) / 30, rtol=1e-15)
    for m, track in enumerate(motion.tracks.values()):
        wanted = np.array([[row[3] for row in pose(k, 5.0 * m)[:3]] for k in range(7)])
        np.testing.assert_allclose(track.position, wanted, rtol=0, atol=2e-6)
        assert track.jaw_angle is not None
        np.testing.assert_allclose(track.jaw_angle, 0.2 * m + 0.1 * np.arange(7), rtol=0, atol=1e-7)
        assert track.closure is None


def test_the_shipped_profile_turns_the_slaves_grippers_into_closure(tmp_path: Path) -> None:
    """closure = 1 - angle / 60°, cut off at 0 and 1: SlaveRight opens from 0.6 rad by 0.1 rad a sample.

    Between the samples, a third of an interval on: linear. The angles have 8 digits, divided by about 1 rad.
    """
    path = put(tmp_path, ".txt", written(7))
    profile = open_profile(str(path)).profile
    assert profile.name == "jigsaws"
    assert profile.recording is not None
    motion = jigsaws.read(path)
    (sensor,) = (s for s in profile.recording.sensor if s.tool == "right")
    time = (np.arange(6) + 1 / 3) / 30
    got = resample_jaws(motion, motion.track(sensor.name), sensor, time)
    angle = 0.6 + 0.1 * (np.arange(6) + 1 / 3)
    ends = np.clip(1 - (0.6 + 0.1 * np.arange(7)) / np.radians(60), 0, 1)
    inside = angle + 0.1 < np.radians(60)
    np.testing.assert_allclose(got[inside], 1 - angle[inside] / np.radians(60), rtol=0, atol=2e-7)
    assert (got[~inside] <= ends[:-1][~inside]).all()
    assert got[-1] == 0.0


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (b"3.0000000e-02", b"", "line 1 has 75 of 76 numbers; expected JIGSAWS kinematics"),
        (b"3.0000000e-02", b"x", "line 1 is not all numbers"),
        (b"3.0000000e-02", b"nan", "line 1: a number is not finite"),
        (b"1.0000000e+00", b"1.5000000e+00", "line 1: the matrix of MasterLeft is not a rotation"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, old: bytes, new: bytes, complaint: str) -> None:
    path = put(tmp_path, ".txt", written().replace(old, new, 1))
    with pytest.raises(ConfigError, match=complaint):
        jigsaws.read(path)
