"""A SpaceMouse as an instrument, through pyspacemouse.

The cap says how fast, not where: its push and twist are velocities, integrated from where the task has the instrument
wait. The instrument stays within a ball of ``reach_mm`` around that place. One button closes the jaws for as long as
it is held, another opens them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from trainer.drivers.connected import Connected
from trainer.drivers.live import LivePoses, Reading, check_tools
from trainer.drivers.makers import failures, library
from trainer.drivers.serial_port import DeviceError
from trainer.geometry import (
    Array,
    Rigid,
    matrix_from_quaternion,
    quaternion_from_axis_angle,
    quaternion_from_euler_deg,
    quaternion_multiply,
)
from trainer.poses import ToolPoses
from trainer.profile import ClosureSpec, Registration, SpacemouseSpec, Tracked

AGAIN_S = 0.005  # between looks at the cap
#: A longer time between two looks counts as this, s: a machine that slept must not fling the instrument. Assumed.
LONGEST_S = 0.05
#: Reports that are read at a look: more than come in between (one of a push and one of a twist each 8 ms, assumed).
REPORTS = 16


def open_spacemouse(
    spec: SpacemouseSpec, closure: ClosureSpec | None, tools: Sequence[str], tick_hz: float, home: ToolPoses
) -> LivePoses:
    """The driver of a profile with a table [spacemouse]. Raises ConfigError, DeviceError."""
    check_tools([spec.tool], tools)
    hand = RateHand(spec, home.world_from_tool(tools.index(spec.tool)))
    moved = Tracked(name=spec.tool, tool=spec.tool)
    # The hand integrates in the world: nothing is left to place.
    open_cap = partial(Connected, "spacemouse", partial(Cap, spec, hand))
    return LivePoses(open_cap, Registration(), [moved], closure, tools, tick_hz, home)


class RateHand:
    """Where velocities have taken an instrument. Of the world: mm, wxyz."""

    def __init__(self, spec: SpacemouseSpec, start: Rigid) -> None:
        self._spec = spec
        self._start = start
        self._scene_from_cap = matrix_from_quaternion(quaternion_from_euler_deg(spec.rotation_deg))
        self._offset = np.zeros(3)
        self._quaternion = start.quaternion.copy()
        self._closure = spec.closure

    def move(self, push: Array, twist: Array, buttons: Sequence[int], seconds: float) -> None:
        """Push (3,) and twist (3,) are shares of full, -1 to 1, along and about the cap's x, y, z (up)."""
        spec, seconds = self._spec, min(seconds, LONGEST_S)
        self._offset += self._scene_from_cap @ self._alive(push) * (spec.speed_mm_s * seconds)
        distance = float(np.linalg.norm(self._offset))
        if distance > spec.reach_mm:
            self._offset *= spec.reach_mm / distance
        turn = self._scene_from_cap @ self._alive(twist) * (math.radians(spec.turn_deg_s) * seconds)
        angle = float(np.linalg.norm(turn))
        if angle > 0.0:
            q = quaternion_multiply(quaternion_from_axis_angle(turn / angle, angle), self._quaternion)
            self._quaternion = q / np.linalg.norm(q)
        way = buttons[spec.close_button] - buttons[spec.open_button]
        self._closure = min(1.0, max(0.0, self._closure + way * seconds / spec.jaw_s))

    def _alive(self, share: Array) -> Array:
        """Without the dead zone, in which a cap at rest trembles; what is beyond begins at 0."""
        share = np.nan_to_num(np.clip(share, -1.0, 1.0))
        beyond = np.maximum(np.abs(share) - self._spec.dead, 0.0) / (1.0 - self._spec.dead)
        return np.asarray(np.sign(share) * beyond)

    def reading(self, now_s: float) -> Reading:
        position = self._start.position + self._offset
        return Reading(self._spec.tool, now_s, position, self._quaternion.copy(), self._closure)


class Cap:
    """An open SpaceMouse that moves ``hand``."""

    def __init__(self, spec: SpacemouseSpec, hand: RateHand) -> None:
        """Raises ConfigError, DeviceError."""
        self._name = spec.device or "SpaceMouse"
        self._hand = hand
        module = library("pyspacemouse", "pyspacemouse")
        with failures(self._name):
            self._device: Any = module.open(
                device=spec.device or None, axis_convention=module.AxisConvention.HID_Z_UP, nonblocking=True
            )
        buttons = len(self._device.state.buttons)
        if buttons <= max(spec.close_button, spec.open_button):
            self.close()
            raise DeviceError(f"{self._name}: has {buttons} buttons; give 'close_button' and 'open_button' two of 0 …")
        self._looked_s = time.monotonic()

    def read(self) -> list[Reading]:
        time.sleep(AGAIN_S)
        with failures(self._name):
            state = self._device.read()
            for _ in range(REPORTS):
                told = state.t
                state = self._device.read()
                if state.t == told:
                    break
            now = time.monotonic()
            push = np.array([state.x, state.y, state.z])
            twist = np.array([state.roll, state.pitch, state.yaw])
            self._hand.move(push, twist, state.buttons, now - self._looked_s)
        self._looked_s = now
        return [self._hand.reading(now)]

    def close(self) -> None:
        try:
            self._device.close()
        except Exception:  # one that was pulled out cannot be closed
            return
