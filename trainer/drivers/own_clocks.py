"""Sensors that each have times of their own, on one clock.

The common clock holds every time at which any sensor was sampled. Between its samples a sensor is where linear
interpolation and slerp put it; those of a part of an interval are parts of the interval's, so what is resampled to
the tick later is what the sensor's own samples would have given. Outside of its samples it was not seen; neither was
it beside a sample that is not OK.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from trainer.geometry import Array, slerp
from trainer.motion import Motion, Track


def on_one_clock(path: str, sampled: Mapping[str, tuple[Array, Track]]) -> Motion:
    """The recording of all sensors, given each one's times (n_k,), never decreasing, and its samples."""
    clocks = [own for own, _ in sampled.values()]
    alike = all(np.array_equal(own, clocks[0]) for own in clocks)
    time = clocks[0] if alike else np.unique(np.concatenate(clocks))
    tracks = {}
    for name, (own, track) in sampled.items():
        tracks[name] = track if np.array_equal(own, time) else _at(time, own, track)
    return Motion(path, time, np.arange(len(time), dtype=np.int64), tracks)


def _at(time: Array, own: Array, track: Track) -> Track:
    after = np.clip(np.searchsorted(own, time, side="left"), 0, len(own) - 1)
    met = own[after] == time
    before = np.where(met, after, np.maximum(after - 1, 0))
    interval = own[after] - own[before]
    fraction = np.zeros(len(time))
    np.divide(time - own[before], interval, out=fraction, where=interval > 0.0)
    ok = track.ok[before] & track.ok[after] & (own[0] <= time) & (time <= own[-1])
    met = met[:, None]
    f = np.clip(fraction, 0.0, 1.0)

    def linear(values: Array) -> Array:
        return np.asarray((1.0 - f) * values[before] + f * values[after])

    position = np.stack([linear(track.position[:, axis]) for axis in range(3)], axis=1)
    quaternion = slerp(track.quaternion[before], track.quaternion[after], f)
    return Track(
        np.where(met, track.position[after], position),
        np.where(met, track.quaternion[after], quaternion),
        ok,
        None if track.closure is None else linear(track.closure),
        None if track.jaw_angle is None else linear(track.jaw_angle),
    )
