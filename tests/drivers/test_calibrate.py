"""From readings to a profile that puts the tip where it was: distortion, tip and scene, one upon the other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drivers.test_field_distortion import GRID
from tests.drivers.test_pivot import cone
from tests.drivers.test_touched_points import PHANTOM
from trainer.calibration import Calibration, CalibrationError, path_for, write
from trainer.config import ConfigError
from trainer.drivers.calibrate import Readings, Sweep, calibrate, read_places, read_readings, read_sweep, sensor_of
from trainer.drivers.recording import map_poses
from trainer.geometry import Array, Rigid, matrix_from_quaternion, quaternion_from_axis_angle
from trainer.profile import Profile, RecordingSpec, Sensor, load_profile

DATE = "2026-03-04T05:06:07+00:00"
TIP = np.array([2.0, -1.0, 90.0])
SCENE_FROM_DEVICE = Rigid(np.array([-250.0, 30.0, 12.0]), quaternion_from_axis_angle([0.3, -0.5, 0.8], 1.1))
ONE = Sensor("Bird", "right")
PROFILE = Profile("mine", "recording", "test", recording=RecordingSpec(sensor=(ONE,)))

TOML = """name = "mine"
driver = "recording"
summary = "test"
[recording]
path = "a.csv"
[[recording.sensor]]
name = "Bird"
tool = "right"
"""


def straight(place: Array) -> Array:
    return place


def touch(known: Array, rng: np.random.Generator, read=straight) -> Readings:  # type: ignore[no-untyped-def]
    """Where the sensor is while the tip touches points of the scene, held as it comes."""
    q = cone(rng, len(known))
    return Readings(read(SCENE_FROM_DEVICE.inverse().apply(known) - matrix_from_quaternion(q) @ TIP), q, known)


def sweep(rng: np.random.Generator, read=straight) -> Sweep:  # type: ignore[no-untyped-def]
    q = cone(rng)
    centre = SCENE_FROM_DEVICE.inverse().apply([50.0, 40.0, 30.0])
    return Sweep(read(centre - matrix_from_quaternion(q) @ TIP), q)


def in_effect(profile: Profile, found: Calibration, folder: Path) -> Profile:
    """The profile as it is loaded beside its calibration."""
    path = folder / "mine.toml"
    path.write_text(TOML)
    write(path_for(path, found), found)
    return load_profile(str(path)).profile


def error(profile: Profile, readings: Readings) -> float:
    """The farthest that the profile's mapping puts the tip from a point that it touches, mm."""
    assert profile.recording is not None
    position, _ = map_poses(readings.position, readings.quaternion, profile.recording, profile.recording.sensor[0])
    return float(np.linalg.norm(position - readings.known, axis=1).max())


def test_a_calibrated_profile_puts_the_tip_on_the_points(tmp_path: Path) -> None:
    """Other points than were touched, held otherwise. No noise: rounding of 500 mm through a file that is exact."""
    rng = np.random.default_rng(0)
    found = calibrate(PROFILE, ONE, DATE, touch(PHANTOM, rng), sweep(rng), None)
    others = touch(rng.uniform(0, 100, size=(50, 3)), rng)
    assert error(in_effect(PROFILE, found, tmp_path), others) < 1e-10
    assert error(PROFILE, others) > 100.0


def test_in_a_bent_field_a_grid_helps_tip_and_scene(tmp_path: Path) -> None:
    """A field that is bent by up to 5 mm within the reach of the sensor, and other points than were touched."""
    rng = np.random.default_rng(1)
    around = SCENE_FROM_DEVICE.inverse().apply([50.0, 40.0, 30.0]) - [0.0, 0.0, 80.0]

    def read(where: Array) -> Array:
        x, y, z = (where - around).T / 90.0
        return np.asarray(where + np.stack([1.5 * np.sin(y), np.cos(x), 1.5 * np.sin(x + z)], axis=1))

    side = np.linspace(-120.0, 120.0, 6)
    grid = np.array([[x, y, z] for x in side for y in side for z in side])
    readings = Readings(read(around + grid), np.tile([1.0, 0.0, 0.0, 0.0], (len(grid), 1)), grid)
    others = touch(rng.uniform(0, 60, size=(50, 3)), rng, read)
    left_over = []
    for used, folder in ((readings, tmp_path / "with"), (None, tmp_path / "without")):
        folder.mkdir()
        found = calibrate(PROFILE, ONE, DATE, touch(PHANTOM, rng, read), sweep(rng, read), used)
        left_over.append(error(in_effect(PROFILE, found, folder), others))
    assert left_over[0] < 0.5 * left_over[1]


def test_what_was_not_measured_anew_is_kept_and_is_in_effect(tmp_path: Path) -> None:
    """First the tip alone, then the points alone, which must know of the tip."""
    rng = np.random.default_rng(2)
    first = calibrate(PROFILE, ONE, "2026-03-04T05:06:06+00:00", None, sweep(rng), None)
    loaded = in_effect(PROFILE, first, tmp_path)
    second = calibrate(loaded, sensor_of(loaded, None), DATE, touch(PHANTOM, rng), None, None)
    assert second.tip == first.tip
    assert second.date == DATE
    assert error(in_effect(PROFILE, second, tmp_path), touch(PHANTOM, rng)) < 1e-10


def test_a_new_grid_keeps_nothing_that_was_measured_in_the_field_as_it_was(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    first = calibrate(PROFILE, ONE, DATE, touch(PHANTOM, rng), sweep(rng), None)
    grid = Readings(GRID * [1.0, 1.03, 1.0], np.tile([1.0, 0.0, 0.0, 0.0], (len(GRID), 1)), GRID)
    second = calibrate(in_effect(PROFILE, first, tmp_path), ONE, DATE, None, None, grid)
    assert second.distortion is not None
    assert (second.scene, second.tip) == (None, ())


def test_where_instruments_start_at_home_points_are_refused() -> None:
    home = replace(PROFILE, recording=RecordingSpec(sensor=(ONE,), anchor="home"))
    with pytest.raises(CalibrationError, match='wherever the scene is; set anchor = "none"'):
        calibrate(home, ONE, DATE, touch(PHANTOM, np.random.default_rng(0)), None, None)
    with pytest.raises(CalibrationError, match="nothing was measured; give --points"):
        calibrate(home, ONE, DATE, None, None, None)


def test_the_sensor_is_the_only_one_or_the_named_one() -> None:
    two = replace(PROFILE, recording=RecordingSpec(sensor=(ONE, Sensor("Other", "left"))))
    assert sensor_of(PROFILE, None) == ONE
    assert sensor_of(two, "Other").tool == "left"
    with pytest.raises(ConfigError, match="name one with --sensor; it has Bird, Other"):
        sensor_of(two, None)
    with pytest.raises(ConfigError, match="no sensor 'Boat'; it has Bird, Other"):
        sensor_of(two, "Boat")
    with pytest.raises(ConfigError, match="device 'mine' has no sensors to calibrate"):
        sensor_of(replace(PROFILE, recording=RecordingSpec()), None)


def table(readings: Readings, oriented: bool) -> str:
    columns = [
        "x_mm",
        "y_mm",
        "z_mm",
        *(["qw", "qx", "qy", "qz"] if oriented else []),
        "scene_x_mm,scene_y_mm,scene_z_mm",
    ]
    parts = [readings.position, *([readings.quaternion] if oriented else []), readings.known]
    rows = [",".join(map(repr, row)) for row in np.concatenate(parts, axis=1).tolist()]
    return "\n".join([",".join(columns), *rows]) + "\n"


def recorded(swept: Sweep) -> str:
    rows = [
        ",".join([repr(0.01 * k), "Bird", *map(repr, [*p, *q])])
        for k, (p, q) in enumerate(zip(swept.position.tolist(), swept.quaternion.tolist(), strict=True))
    ]
    return "\n".join(["time_s,tool,x_mm,y_mm,z_mm,qw,qx,qy,qz", *rows]) + "\n"


def test_files_give_what_arrays_give(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    points, swept = touch(PHANTOM, rng), sweep(rng)
    (tmp_path / "points.csv").write_text(table(points, oriented=True))
    (tmp_path / "sweep.csv").write_text(recorded(swept))
    read = read_readings(tmp_path / "points.csv"), read_sweep(tmp_path / "sweep.csv", ONE.name)
    assert calibrate(PROFILE, ONE, DATE, *read, None) == calibrate(PROFILE, ONE, DATE, points, swept, None)
    assert read_places(tmp_path / "points.csv") is None
    (tmp_path / "places.csv").write_text("scene_x_mm,scene_y_mm,scene_z_mm\n1,2,3\n4,5,6\n")
    np.testing.assert_array_equal(read_places(tmp_path / "places.csv"), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])


def test_readings_without_orientation_are_of_the_tip_itself(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(table(touch(PHANTOM, np.random.default_rng(5)), oriented=False))
    assert (read_readings(tmp_path / "points.csv").quaternion == [1.0, 0.0, 0.0, 0.0]).all()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "the file is empty"),
        ("x_mm,y_mm,z_mm\n1,2,3\n", "no column 'scene_x_mm'"),
        ("x_mm,y_mm,z_mm,scene_x_mm,scene_y_mm,scene_z_mm\n1,2,3,4,5,\n", "line 2: 'scene_z_mm' expected a number"),
        ("x_mm,y_mm,z_mm,scene_x_mm,scene_y_mm,scene_z_mm\n", "holds no row below its heading"),
        ("x_mm,y_mm,z_mm,scene_x_mm,scene_y_mm,scene_z_mm\n1,2,3,4,5,6", "is cut short"),
    ],
)
def test_a_bad_table_of_points_is_one_line(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=complaint) as caught:
        read_readings(path)
    assert str(caught.value).startswith(f"{path}: ")
