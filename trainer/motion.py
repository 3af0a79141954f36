"""Recorded motion as plain data: what sensors did on their common clock, whatever file it came from."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from trainer.config import ConfigError
from trainer.geometry import Array


@dataclass(frozen=True)
class Track:
    """One sensor. Rows where the tracker did not see it hold no pose: nobody may rely on what they hold."""

    position: Array  # (n, 3) mm, reference frame
    quaternion: Array  # (n, 4) wxyz, reference_from_sensor
    ok: np.ndarray  # (n,) bool
    closure: Array | None = None  # (n,) 0 open … 1 closed, where jaws were recorded
    jaw_angle: Array | None = None  # (n,) rad, where an angle was recorded instead


@dataclass(frozen=True)
class Motion:
    """All sensors of a recording on their common, irregular clock."""

    path: str
    time: Array  # (n,) s, never decreasing
    frame_number: np.ndarray  # (n,) int64, as the device counted
    tracks: dict[str, Track]  # by name, in the order of the file

    @property
    def duration_s(self) -> float:
        return float(self.time[-1] - self.time[0])

    @property
    def gaps(self) -> int:
        """How often the device skipped frames."""
        return int(np.count_nonzero(np.diff(self.frame_number) > 1))

    @property
    def missing_frames(self) -> int:
        """How many frames the device skipped."""
        jumps = np.diff(self.frame_number)
        return int(np.sum(jumps[jumps > 1] - 1))

    @property
    def sensors(self) -> list[str]:
        """Names without the reference (``ProbeToTracker``), or whole names where that would leave two alike."""
        short = [_short(name) for name in self.tracks]
        return [s if short.count(s) == 1 else name for s, name in zip(short, self.tracks, strict=True)]

    def track(self, sensor: str) -> Track:
        """The sensor ``Probe``, also called ``ProbeToTracker``. Raises ConfigError for one that is not there."""
        if sensor in self.tracks:
            return self.tracks[sensor]
        if sensor in self.sensors:
            return list(self.tracks.values())[self.sensors.index(sensor)]
        raise ConfigError(f"{self.path}: no sensor '{sensor}'; it has {', '.join(self.sensors)}")


def describe(motion: Motion) -> dict[str, object]:
    """Size, clock, gaps and each sensor's range of motion, ready for JSON."""
    interval = 1e3 * np.diff(motion.time) if len(motion.time) > 1 else np.zeros(1)
    sensors: dict[str, object] = {}
    for name, track in zip(motion.sensors, motion.tracks.values(), strict=True):
        seen = track.position[track.ok]
        sensors[name] = {
            "frames_ok": len(seen),
            "low_mm": seen.min(axis=0).tolist() if len(seen) else None,
            "high_mm": seen.max(axis=0).tolist() if len(seen) else None,
            "path_length_mm": float(np.linalg.norm(np.diff(seen, axis=0), axis=1).sum()),
        }
    return {
        "frames": len(motion.time),
        "duration_s": motion.duration_s,
        "interval_median_ms": float(np.median(interval)),
        "interval_p99_ms": float(np.percentile(interval, 99)),
        "interval_max_ms": float(interval.max()),
        "gaps": motion.gaps,
        "missing_frames": motion.missing_frames,
        "sensors": sensors,
    }


def _short(name: str) -> str:
    match = re.fullmatch(r"(.+?)To[A-Z]\w*", name)
    return match[1] if match else name
