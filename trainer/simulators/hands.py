"""Where simulated sensors are: at rest, as recorded, or as a session's instruments moved."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trainer.config import ConfigError
from trainer.drivers import is_logged, sequence_file
from trainer.geometry import Array, Rigid, quaternion_from_euler_deg, quaternion_multiply, slerp
from trainer.profile import Bird, MinibirdSpec

#: Where sensors rest that nothing moves, mm from the transmitter along the hemisphere's axis (assumed).
REST_MM = 300.0
#: A session ends in the tick in which its last goal is reached, its hands still on the way there. They go on as they
#: moved in their last tenth of a second for so long, s: who plays them again may need a little more of it.
FOLLOW_THROUGH_S = 1.0
HEMISPHERE_AXIS = {
    "forward": (0, 1),
    "aft": (0, -1),
    "right": (1, 1),
    "left": (1, -1),
    "lower": (2, 1),
    "upper": (2, -1),
}


@dataclass(frozen=True)
class Hands:
    """Motion of the k sensors of a flock."""

    addresses: tuple[int, ...]  # of their birds: all from 1 to the profile's highest, which a flock needs
    time: Array  # (n,) s from the start
    position: Array  # (n, k, 3) mm, transmitter frame
    quaternion: Array  # (n, k, 4) wxyz, transmitter_from_sensor
    closure: Array  # (n, k) of the instrument
    sampled: bool  # the device measures when the motion was sampled, each sample once
    in_scene: bool  # the motion is that of instruments in a scene, seen through the profile's mapping

    @property
    def duration_s(self) -> float:
        return float(self.time[-1])

    def at(self, time_s: float, bird: int) -> Rigid:
        """The pose at ``time_s``; before and after the motion its first and last."""
        a, b, share = self._between(time_s)
        if share == 0.0:
            return Rigid(self.position[a, bird], self.quaternion[a, bird])
        position = self.position[a, bird] + share * (self.position[b, bird] - self.position[a, bird])
        return Rigid(position, slerp(self.quaternion[a, bird], self.quaternion[b, bird], share))

    def closure_at(self, time_s: float, bird: int) -> float:
        """Likewise."""
        a, b, share = self._between(time_s)
        return float(self.closure[a, bird] + share * (self.closure[b, bird] - self.closure[a, bird]))

    def _between(self, time_s: float) -> tuple[int, int, float]:
        """Two neighbouring samples, and how far ``time_s`` is from the first to the second."""
        after = int(np.searchsorted(self.time, time_s, side="right"))
        a, b = max(after - 1, 0), min(after, len(self.time) - 1)
        span = float(self.time[b] - self.time[a])
        if self.sampled or span <= 0.0:
            return a, b, 0.0
        return a, b, min(max((time_s - float(self.time[a])) / span, 0.0), 1.0)


def open_hands(motion: str, spec: MinibirdSpec) -> Hands:
    """The motion that ``--motion`` names: a tracker's recording, a session of the log, or "" for rest.

    Raises ConfigError, LogError.
    """
    addresses = tuple(range(1, max(bird.address for bird in spec.bird) + 1))
    if not motion:
        return _resting(spec, addresses)
    if is_logged(motion):
        return _logged(motion, spec, addresses)
    sequence = sequence_file.read(motion)
    tracks = list(sequence.tracks.values())
    if len(tracks) < len(addresses):
        raise ConfigError(f"{motion}: {len(addresses)} birds need as many sensors, found {len(tracks)}")
    tracks = tracks[: len(addresses)]
    return Hands(
        addresses=addresses,
        time=sequence.time - sequence.time[0],
        position=np.stack([t.position for t in tracks], axis=1),
        quaternion=np.stack([t.quaternion for t in tracks], axis=1),
        closure=np.ones((len(sequence.time), len(tracks))),
        sampled=True,
        in_scene=False,
    )


def _resting(spec: MinibirdSpec, addresses: tuple[int, ...]) -> Hands:
    k = len(addresses)
    axis, sign = HEMISPHERE_AXIS[spec.hemisphere]
    position = np.zeros((1, k, 3))
    position[:, :, axis] = sign * REST_MM
    position[0, :, (axis + 1) % 3] = 50.0 * np.arange(k)
    quaternion = np.tile(quaternion_from_euler_deg((30.0, 40.0, 20.0)), (1, k, 1))
    return Hands(addresses, np.zeros(1), position, quaternion, np.zeros((1, k)), sampled=False, in_scene=False)


def _logged(motion: str, spec: MinibirdSpec, addresses: tuple[int, ...]) -> Hands:
    """A session's instruments as the sensors on them were, by the profile's mapping."""
    from trainer.log import reader  # takes a while, and rest needs none

    path, _, session = motion.rpartition("#")
    with reader.open_log(Path(path)) as log:
        record = reader.load(log, session)
    missing = [bird.tool for bird in spec.bird if bird.tool not in record.header.tools]
    if missing:
        raise ConfigError(f"{motion}: has no instrument '{missing[0]}'")
    birds = {bird.address: bird for bird in spec.bird}
    # A bird that moves no instrument of the profile goes along with the first that does.
    moved = [birds.get(address, spec.bird[0]) for address in addresses]
    columns = [record.header.tools.index(bird.tool) for bird in moved]
    n, hz = len(record.position), record.header.tick_hz
    sensors = [
        _sensor(record.position[:, c], record.quaternion[:, c], spec, b) for c, b in zip(columns, moved, strict=True)
    ]
    position = np.stack([p for p, _ in sensors], axis=1)
    quaternion = np.stack([q for _, q in sensors], axis=1)
    before = max(0, n - 1 - round(0.1 * hz))
    velocity = (position[-1] - position[before]) * hz / max(1, n - 1 - before)
    return Hands(
        addresses=addresses,
        time=np.append(np.arange(n) / hz, (n - 1) / hz + FOLLOW_THROUGH_S),
        position=np.append(position, position[-1:] + FOLLOW_THROUGH_S * velocity, axis=0),
        quaternion=np.append(quaternion, quaternion[-1:], axis=0),
        closure=np.append(record.closure[:, columns], record.closure[-1:, columns], axis=0),
        sampled=False,
        in_scene=True,
    )


def _sensor(position: Array, quaternion: Array, spec: MinibirdSpec, bird: Bird) -> tuple[Array, Array]:
    """Sensor poses (n, 3), (n, 4) in the transmitter's frame of tool poses in the scene's."""
    scene_from_device = Rigid(np.array(spec.position_mm), quaternion_from_euler_deg(spec.rotation_deg))
    tool_from_sensor = Rigid(np.array(bird.position_mm), quaternion_from_euler_deg(bird.rotation_deg)).inverse()
    device_from_scene = scene_from_device.inverse()
    turned = quaternion_multiply(quaternion, tool_from_sensor.quaternion)
    placed = np.array([Rigid(p, q).apply(tool_from_sensor.position) for p, q in zip(position, quaternion, strict=True)])
    in_device = quaternion_multiply(device_from_scene.quaternion, turned)
    return device_from_scene.apply(placed) / spec.scale, in_device
