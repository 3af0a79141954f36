"""What drivers of devices in a hand share: when a tick is due, where a pose lies, how late it is, when and why none is.

The loop takes the newest pose and never waits for one. An instrument without a fresh pose counts as not seen: the
scene leaves it where it is, jaws and all, and the summary says why and how long.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from trainer.drivers import field_distortion
from trainer.drivers.latency import LatencyCount
from trainer.geometry import Array, Rigid, quaternion_from_euler_deg
from trainer.poses import ToolPoses
from trainer.profile import Mount, Registration

#: A stream's first sample may take this long after the session began.
FIRST_S = 0.5
#: How long a thread computes before it lets one that has read something have a turn; 5 ms by default. Assumed.
SWITCH_S = 0.0005
#: As many losses are told one by one; a worse session is told by their number.
MOST_LOSSES = 100
MOST_REASONS = 4  # of one loss


class Pace:
    """The session's ticks by the clock, from the first that is asked for."""

    def __init__(self, tick_hz: float) -> None:
        self.tick_s = 1.0 / tick_hz
        self.begun_s: float | None = None

    def wait(self, tick: int) -> float:
        """Sleeps until ``tick`` is due where nobody else paces the session; gives the time, s."""
        now = time.monotonic()
        if self.begun_s is None:
            self.begun_s = now
        # Half a tick early is early enough: a clock that paces the session has waited already.
        ahead_s = self.begun_s + (tick - 0.5) * self.tick_s - now
        if ahead_s > 0.0:
            time.sleep(ahead_s)
            now = time.monotonic()
        return now

    def starting(self, now_s: float) -> bool:
        """Whether it is too early to miss a first sample."""
        return self.begun_s is None or now_s - self.begun_s <= FIRST_S


class Placer:
    """A sensor's poses, moved into the world as the profile says."""

    def __init__(self, spec: Registration, home: ToolPoses) -> None:
        self._spec = spec
        self._home = home
        self._scene_from_device = Rigid(np.array(spec.position_mm), quaternion_from_euler_deg(spec.rotation_deg))
        self._anchor: dict[int, Rigid] = {}
        self._mounts: dict[int, Rigid] = {}

    def world_from_tool(self, tool: int, position: Array, quaternion: Array, mount: Mount) -> Rigid:
        """Where a sensor at ``position`` (3,) mm, ``quaternion`` (4,) wxyz of the device has its instrument."""
        position = field_distortion.correct(position[None], self._spec.distortion)[0]
        device_from_sensor = Rigid(self._spec.scale * position, quaternion)
        if tool not in self._mounts:
            self._mounts[tool] = Rigid(np.array(mount.position_mm), quaternion_from_euler_deg(mount.rotation_deg))
        pose = self._scene_from_device @ device_from_sensor @ self._mounts[tool]
        if self._spec.anchor == "none":
            return pose
        if tool not in self._anchor:
            self._anchor[tool] = self._home.world_from_tool(tool) @ pose.inverse()
        return self._anchor[tool] @ pose


class Latency:
    """How long poses take from the device to the events of the tick that used them."""

    def __init__(self) -> None:
        self.count = LatencyCount()
        self._fresh: list[float] = []

    def begin(self) -> None:
        """A tick begins; poses of one whose events nobody told of are forgotten."""
        self._fresh.clear()

    def used(self, sent_s: float) -> None:
        """This tick uses a pose, sent then, that none used before."""
        self._fresh.append(sent_s)

    def told(self) -> None:
        """The tick's events are with the sinks."""
        now = time.monotonic()
        for sent_s in self._fresh:
            self.count.add(1e3 * (now - sent_s))
        self._fresh.clear()

    def summary(self) -> dict[str, object]:
        return dict(self.count.summary())


@dataclass
class _Loss:
    tick: int
    reasons: list[str] = field(default_factory=list)  # why, as far as it is known by now

    def told(self, tool: str, until: int, tick_s: float) -> dict[str, object]:
        lost_s = round((until - self.tick) * tick_s, 3)
        return {"tool": tool, "tick": self.tick, "lost_s": lost_s, "reason": "; ".join(self.reasons)}


class Losses:
    """When instruments were not seen, how long, and why."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s = tick_s
        self._tick = 0
        self._now: dict[str, _Loss] = {}  # by tool
        self._past: list[dict[str, object]] = []
        self._count = 0

    def note(self, tool: str, tick: int, reason: str) -> None:
        """At ``tick`` the instrument is seen, or is not for a reason."""
        self._tick = tick
        if reason:
            # First nothing comes, then it turns out why.
            reasons = self._now.setdefault(tool, _Loss(tick)).reasons
            if reason not in reasons and len(reasons) < MOST_REASONS:
                reasons.append(reason)
        elif tool in self._now:
            self._count += 1
            loss = self._now.pop(tool)
            if len(self._past) < MOST_LOSSES:
                self._past.append(loss.told(tool, tick, self._tick_s))

    def summary(self) -> dict[str, object]:
        still = [loss.told(tool, self._tick + 1, self._tick_s) for tool, loss in self._now.items()]
        return {"losses": self._count + len(still), "lost": self._past + still}
