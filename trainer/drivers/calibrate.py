"""A calibration from what was measured: readings and poses in, the tables of a calibration's file out.

What is fitted first is in effect for what comes after: the field's distortion, then the tip, then where the scene is.
What was not measured anew is kept from the calibration in use; a new grid keeps nothing, since the rest was measured in
the field as it was.

The readings come from files, or from a live device (:mod:`trainer.drivers.watch`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from trainer.calibration import Calibration, CalibrationError
from trainer.config import ConfigError
from trainer.drivers import field_distortion, motion_file, pivot, pose_table, touched_points
from trainer.drivers.plausible import unit_quaternions
from trainer.drivers.recording import map_poses
from trainer.geometry import Array
from trainer.profile import Mount, Profile, RecordingSpec, Registration, Sensor

#: Columns of a table of readings at known places; the sensor's orientation may stand beside them (qw qx qy qz).
READING = pose_table.POSITION
KNOWN = ("scene_x_mm", "scene_y_mm", "scene_z_mm")


@dataclass(frozen=True)
class Readings:
    """What the device said at known places."""

    position: Array  # (n, 3) mm, of the sensor in the device's frame
    quaternion: Array  # (n, 4) device_from_sensor
    known: Array  # (n, 3) mm, in the scene; of a grid: in any frame that stands still


@dataclass(frozen=True)
class Sweep:
    """Poses of a sensor while its tip rested."""

    position: Array  # (n, 3) mm
    quaternion: Array  # (n, 4)


def mapping(profile: Profile) -> RecordingSpec:
    """How a profile maps its sensors, of which those of a flock are called bird1, bird2 … Raises ConfigError."""
    flock, server, tracker = profile.minibird, profile.openigtlink, profile.ndi
    if profile.driver == "recording" and profile.recording is not None and profile.recording.sensor:
        return profile.recording
    if profile.driver == "minibird" and flock is not None:
        return _mapping(flock, {bird.name: (bird.tool, bird) for bird in flock.bird})
    if profile.driver == "openigtlink" and server is not None:
        return _mapping(server, {device.name: (device.tool, device) for device in server.device})
    if profile.driver == "ndi" and tracker is not None:
        return _mapping(tracker, {sensor.name: (sensor.tool, sensor) for sensor in tracker.sensor})
    raise ConfigError(f"device '{profile.name}' has no sensors to calibrate")


def _mapping(spec: Registration, sensors: Mapping[str, tuple[Literal["left", "right"], Mount]]) -> RecordingSpec:
    """The registration of a device in the hand, with each sensor's instrument and place on it."""
    return RecordingSpec(
        sensor=tuple(
            Sensor(name, tool, position_mm=mount.position_mm, rotation_deg=mount.rotation_deg)
            for name, (tool, mount) in sensors.items()
        ),
        scale=spec.scale,
        position_mm=spec.position_mm,
        rotation_deg=spec.rotation_deg,
        anchor=spec.anchor,
        distortion=spec.distortion,
    )


def sensor_of(profile: Profile, name: str | None) -> Sensor:
    """The sensor that is calibrated: the named one, or the only one. Raises ConfigError."""
    sensors = {sensor.name: sensor for sensor in mapping(profile).sensor}
    if name is None and len(sensors) == 1:
        return next(iter(sensors.values()))
    if name not in sensors:
        found = "name one with --sensor" if name is None else f"no sensor '{name}'"
        raise ConfigError(f"device '{profile.name}': {found}; it has {', '.join(sensors)}")
    return sensors[name]


def check_anchor(profile: Profile) -> None:
    """Raises CalibrationError where touched points say nothing of where the instruments are."""
    if mapping(profile).anchor == "home":
        raise CalibrationError(
            f"device '{profile.name}' starts each instrument where its task has it wait, wherever the scene is; "
            f'set anchor = "none" in [{profile.driver}]'
        )


def calibrate(
    profile: Profile, sensor: Sensor, date: str, points: Readings | None, sweep: Sweep | None, grid: Readings | None
) -> Calibration:
    """The calibration of ``date`` (UTC, ISO 8601) from what was measured with ``sensor``.

    Raises CalibrationError where it determines nothing or fits poorly.
    """
    spec = mapping(profile)
    if points is None and sweep is None and grid is None:
        raise CalibrationError("nothing was measured; give --points, --sweep or --grid")
    if points is not None:
        check_anchor(profile)
    kept = profile.calibration if profile.calibration is not None and grid is None else Calibration(date)
    found = replace(kept, date=date)
    if grid is not None:
        found = replace(found, distortion=field_distortion.fit(grid.position, grid.known))
        spec = replace(spec, distortion=found.distortion)
    if sweep is not None:
        at = field_distortion.correct(sweep.position, spec.distortion)
        tip = pivot.fit(at, sweep.quaternion).of(sensor.name)
        found = replace(found, tip=(*(t for t in found.tip if t.sensor != sensor.name), tip))
        sensor = replace(sensor, position_mm=tip.position_mm)
    if points is not None:
        found = replace(found, scene=_place(points, spec, sensor).placement())
    return found


def _place(points: Readings, spec: RecordingSpec, sensor: Sensor) -> touched_points.Fit:
    """Where the scene is, given the tip as the recording's mapping will have it."""
    of_device = replace(spec, position_mm=(0.0, 0.0, 0.0), rotation_deg=(0.0, 0.0, 0.0))
    tip, _ = map_poses(points.position, points.quaternion, of_device, sensor)
    return touched_points.fit(tip, points.known)


def read_places(path: Path) -> Array | None:
    """Known places (n, 3) of a table that holds no readings there: the device is to be read at each; else None.

    Raises ConfigError.
    """
    rows = pose_table.read_rows(path, ())
    if any(column in rows[0][0] for column in READING) or not all(column in rows[0][0] for column in KNOWN):
        return None
    return pose_table.numbers(rows, KNOWN, str(path))


def read_readings(path: Path) -> Readings:
    """Readings at known places from a CSV table: ``x_mm`` …, ``scene_x_mm`` …, and where known ``qw`` … ``qz``.

    Raises ConfigError.
    """
    rows = pose_table.read_rows(path, (*READING, *KNOWN))
    name, seen = str(path), np.ones(len(rows), dtype=bool)
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1))
    if all(column in rows[0][0] for column in pose_table.QUATERNION):
        read = pose_table.numbers(rows, pose_table.QUATERNION, name)
        quaternion = unit_quaternions(read, seen, name, [f"line {line}" for _, line in rows])
    return Readings(pose_table.numbers(rows, READING, name), quaternion, pose_table.numbers(rows, KNOWN, name))


def read_sweep(path: Path, sensor: str) -> Sweep:
    """The poses in which a recording of any format saw a sensor. Raises ConfigError."""
    track = motion_file.read(path).track(sensor)
    return Sweep(track.position[track.ok], track.quaternion[track.ok])
