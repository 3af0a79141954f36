"""Recorded sensor motion, resampled to the tick and mapped to the instruments.

**Resampling.** t = 0 is the first sample. A tick lies between two neighbouring samples of the irregular
clock ``Timestamp``: position is interpolated linearly, rotation by slerp. The input ends with the last tick
that is not later than the last sample.

**Validity.** A tick is invalid for an instrument when a sample it is made from is not OK, or when it lies in
an interval in which the device's frame number jumps by more than 1 and no real sample is within half a tick
of it. So every gap of at least two ticks (20 ms at 100 Hz) is lost and found again by itself, even where one
sample alone stands between two gaps. Poses stay finite throughout: where a sample is not OK the last one
that was is held (before the first, that one).

**Mapping.** ``world_from_tool = anchor · scene_from_device · (scale · position, rotation) · sensor_from_tool``, where a
calibration corrects the position first (:mod:`trainer.drivers.field_distortion`).
With ``anchor = "home"`` each instrument has its own anchor, which moves its first OK sample, rotation too,
onto the pose in which the task has it wait. An instrument without a sensor stays there.

**Jaws.** Closure as recorded, or from the recorded angle between the two at which the profile says that the jaws are
open and closed; where the file knows of neither, the profile's constant ``closure``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trainer.config import ConfigError
from trainer.drivers import motion_file
from trainer.drivers.field_distortion import correct
from trainer.geometry import (
    Array,
    Rigid,
    matrix_from_quaternion,
    quaternion_from_euler_deg,
    quaternion_multiply,
    slerp,
)
from trainer.motion import Motion, Track
from trainer.poses import ToolPoses
from trainer.profile import RecordingSpec, Sensor

#: A longer recording has a broken time stamp, or times in another unit.
LONGEST_S = 86400.0
#: Why an instrument is lost: samples are missing there, or are not OK.
UNSEEN = "missing from the recording"


class Recording:
    """Driver that plays a recorded motion; everything is computed when it is opened."""

    def __init__(self, path: Path, spec: RecordingSpec, tools: Sequence[str], tick_hz: float, home: ToolPoses) -> None:
        """``tools`` are the task's instruments in the order of ``home``. Raises ConfigError."""
        self._motion = motion_file.read(path)
        check_sensors(self._motion, spec)
        self._time = tick_times(self._motion, tick_hz)
        self._end = neighbours(self._motion.time, self._time)[1]
        ticks = len(self._time)
        self._position = np.tile(home.position, (ticks, 1, 1))
        self._quaternion = np.tile(home.quaternion, (ticks, 1, 1))
        self._valid = np.tile(np.asarray(home.valid, dtype=bool), (ticks, 1))
        self._closure = np.tile(home.closure, (ticks, 1))
        self._sensors: dict[str, str] = {}
        for sensor in spec.sensor:
            if sensor.tool not in tools:
                continue
            k = tools.index(sensor.tool)
            track = self._motion.track(sensor.name)
            sampled = resample(self._motion, track, self._time, tick_hz)
            first = int(np.argmax(track.ok))
            start = map_poses(track.position[first], track.quaternion[first], spec, sensor)
            anchor = Rigid.identity()
            if spec.anchor == "home":
                anchor = home.world_from_tool(k) @ Rigid(*start).inverse()
            mapped = _compose(anchor, *map_poses(sampled[0], sampled[1], spec, sensor))
            self._position[:, k], self._quaternion[:, k] = mapped
            self._valid[:, k] = sampled[2]
            self._closure[:, k] = resample_jaws(self._motion, track, sensor, self._time)
            self._sensors[sensor.tool] = sensor.name
        self._consumed = 0

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        if tick >= len(self._time):
            self._consumed = len(self._motion.time)
            return None
        self._consumed = int(self._end[tick]) + 1
        valid = self._valid[tick]
        reason = tuple("" if seen else UNSEEN for seen in valid)
        return ToolPoses(self._position[tick], self._quaternion[tick], self._closure[tick], valid, reason)

    def summary(self) -> dict[str, object]:
        """Counts of the whole file and, as ``frames_consumed``, how many of its frames were played."""
        return {
            "driver": "recording",
            "path": self._motion.path,
            "frames": len(self._motion.time),
            "frames_consumed": self._consumed,
            "gaps": self._motion.gaps,
            "missing_frames": self._motion.missing_frames,
            "duration_s": self._motion.duration_s,
            "sensors": self._sensors,
        }

    def close(self) -> None:
        """Nothing stays open."""


def check_sensors(motion: Motion, spec: RecordingSpec) -> None:
    """Raises ConfigError when the profile's sensors do not fit the file or each other."""
    if not spec.sensor:
        raise ConfigError(f"{motion.path}: the profile names no sensor; add [[recording.sensor]]")
    tools = [sensor.tool for sensor in spec.sensor]
    for sensor in spec.sensor:
        if tools.count(sensor.tool) > 1:
            raise ConfigError(f"{motion.path}: the profile maps two sensors to the instrument '{sensor.tool}'")
        if not motion.track(sensor.name).ok.any():
            raise ConfigError(f"{motion.path}: sensor '{sensor.name}' is not OK in any frame")


def tick_times(motion: Motion, tick_hz: float) -> Array:
    """Times (m,) s from the first sample of all ticks up to the last sample. Raises ConfigError beyond a day."""
    if not motion.duration_s <= LONGEST_S:
        raise ConfigError(f"{motion.path}: lasts {motion.duration_s:g} s; are its times in seconds?")
    # A millionth of a tick decides that a last tick at the very time of the last sample is one.
    return np.arange(int(np.floor(motion.duration_s * tick_hz + 1e-6)) + 1) / tick_hz


def neighbours(sample_time: Array, time: Array) -> tuple[np.ndarray, np.ndarray, Array]:
    """For each of ``time`` (m,), s from the first sample: index of the sample before it, after it, fraction."""
    t = sample_time - sample_time[0]
    n = len(t)
    before = np.clip(np.searchsorted(t, time, side="right") - 1, 0, max(n - 2, 0))
    after = np.minimum(before + 1, n - 1)
    interval = t[after] - t[before]
    fraction = np.ones(len(time))
    np.divide(time - t[before], interval, out=fraction, where=interval > 0.0)
    return before, after, np.clip(fraction, 0.0, 1.0)


def resample(motion: Motion, track: Track, time: Array, tick_hz: float) -> tuple[Array, Array, np.ndarray]:
    """Position (m, 3), quaternion (m, 4) and validity (m,) of one sensor at ``time`` (m,), as the module says."""
    before, after, fraction = neighbours(motion.time, time)
    ok = track.ok
    held = np.maximum.accumulate(np.where(ok, np.arange(len(ok)), int(np.argmax(ok))))
    a, b = held[before], held[after]
    position = (1.0 - fraction[:, None]) * track.position[a] + fraction[:, None] * track.position[b]
    quaternion = slerp(track.quaternion[a], track.quaternion[b], fraction)

    seen = (ok[before] | (fraction == 1.0)) & (ok[after] | (fraction == 0.0))
    t = motion.time - motion.time[0]
    near = np.minimum(np.abs(time - t[before]), np.abs(t[after] - time)) <= 0.5 / tick_hz
    skipped = motion.frame_number[after] - motion.frame_number[before] > 1
    return position, quaternion, seen & (near | ~skipped)


def recorded_closure(track: Track, sensor: Sensor) -> Array | None:
    """Closure (n,) of each sample, 0 open … 1 closed; None where the recording or the profile knows of no jaws."""
    if track.closure is not None:
        return np.asarray(np.clip(track.closure, 0.0, 1.0))
    if track.jaw_angle is None or sensor.jaw_open_deg is None or sensor.jaw_closed_deg is None:
        return None
    wide = np.degrees(track.jaw_angle) - sensor.jaw_closed_deg
    return np.asarray(np.clip(1.0 - wide / (sensor.jaw_open_deg - sensor.jaw_closed_deg), 0.0, 1.0))


def resample_jaws(motion: Motion, track: Track, sensor: Sensor, time: Array) -> Array:
    """Closure (m,) at ``time`` (m,), linear between samples; the profile's, where the recording knows of no jaws."""
    recorded = recorded_closure(track, sensor)
    if recorded is None:
        return np.full(len(time), sensor.closure)
    before, after, fraction = neighbours(motion.time, time)
    return np.asarray((1.0 - fraction) * recorded[before] + fraction * recorded[after])


def map_poses(position: Array, quaternion: Array, spec: RecordingSpec, sensor: Sensor) -> tuple[Array, Array]:
    """Sensor poses ``(..., 3)``, ``(..., 4)`` in the device's frame as tool poses in the scene's, before the anchor."""
    scene_from_device = Rigid(np.array(spec.position_mm), quaternion_from_euler_deg(spec.rotation_deg))
    position = correct(position, spec.distortion)
    offset = matrix_from_quaternion(quaternion) @ np.array(sensor.position_mm)
    turned = quaternion_multiply(quaternion, quaternion_from_euler_deg(sensor.rotation_deg))
    return _compose(scene_from_device, spec.scale * position + offset, turned)


def _compose(a_from_b: Rigid, position: Array, quaternion: Array) -> tuple[Array, Array]:
    """Poses in frame b as poses in frame a."""
    q = quaternion_multiply(a_from_b.quaternion, quaternion)
    return a_from_b.apply(position), q / np.linalg.norm(q, axis=-1, keepdims=True)
