"""A SpaceMouse behind a library of the real one's shape: velocities integrated within limits, buttons as jaws."""

from __future__ import annotations

import enum
import math
import sys
import threading
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_polling import HOME, TICK_HZ, TOOLS, Polling, all_seen, none_seen

from trainer.config import ConfigError
from trainer.drivers.serial_port import DeviceError
from trainer.drivers.spacemouse import LONGEST_S, RateHand, open_spacemouse
from trainer.geometry import Rigid, quaternion_from_axis_angle
from trainer.profile import SpacemouseSpec

SPEC = SpacemouseSpec(tool="right", speed_mm_s=20.0, turn_deg_s=90.0, reach_mm=5.0, dead=0.1, jaw_s=0.5, closure=0.5)
START = Rigid(np.array([1.0, 2.0, 3.0]), quaternion_from_axis_angle([1.0, 0.0, 0.0], 1.0))
STILL = np.zeros(3)
FULL = np.array([1.0, 0.0, 0.0])
NO_BUTTON = (0, 0)


def moved(spec: SpacemouseSpec, push: np.ndarray, twist: np.ndarray, steps: int, buttons: Any = NO_BUTTON) -> RateHand:
    hand = RateHand(spec, START)
    for _ in range(steps):
        hand.move(push, twist, buttons, 0.01)
    return hand


def test_a_push_is_a_velocity() -> None:
    """20 mm/s for 0.1 s; ten sums of 0.2 mm round by a few 1e-16."""
    reading = moved(SPEC, FULL, STILL, 10).reading(0.0)
    np.testing.assert_allclose(reading.position, START.position + 2.0 * FULL, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(reading.quaternion, START.quaternion)


def test_a_twist_turns_about_the_tip_and_the_world_s_axis() -> None:
    """90°/s about z for 0.5 s. Fifty products of quaternions round by 50 · 1e-16, with a margin of ten."""
    reading = moved(SPEC, STILL, np.array([0.0, 0.0, 1.0]), 50).reading(0.0)
    turn = Rigid(STILL, quaternion_from_axis_angle([0.0, 0.0, 1.0], math.radians(45.0)))
    expected = (turn @ Rigid(STILL, START.quaternion)).quaternion
    np.testing.assert_allclose(reading.quaternion, expected, rtol=0, atol=5e-14)
    np.testing.assert_array_equal(reading.position, START.position)


def test_the_cap_s_axes_are_turned_into_the_scene_s() -> None:
    spec = SpacemouseSpec(tool="right", rotation_deg=(0.0, 0.0, 90.0), dead=0.0)
    reading = moved(spec, FULL, STILL, 10).reading(0.0)
    np.testing.assert_allclose(reading.position, START.position + np.array([0.0, 2.0, 0.0]), rtol=0, atol=1e-14)


def test_the_dead_zone_is_still_and_begins_at_no_speed() -> None:
    """At 0.1 nothing; at 0.55, half of what is beyond, half the speed."""
    np.testing.assert_array_equal(moved(SPEC, 0.1 * FULL, STILL, 10).reading(0.0).position, START.position)
    position = moved(SPEC, -0.55 * FULL, STILL, 10).reading(0.0).position
    np.testing.assert_allclose(position, START.position - FULL, rtol=0, atol=1e-14)


@given(
    st.lists(
        st.tuples(
            st.lists(st.floats(allow_infinity=True), min_size=6, max_size=6),
            st.tuples(st.integers(0, 1), st.integers(0, 1)),
            st.floats(0.0, 1e6),
        ),
        max_size=30,
    )
)
def test_no_cap_leaves_the_reach_or_makes_no_pose(reports: list[tuple[list[float], tuple[int, int], float]]) -> None:
    """Within reach_mm (a scaled vector's length is off by a few 1e-16 of it), at the top speeds at most; always a
    pose. A look after a long sleep counts as one after 50 ms."""
    hand = RateHand(SPEC, START)
    before = hand.reading(0.0)
    for axes, buttons, seconds in reports:
        hand.move(np.array(axes[:3]), np.array(axes[3:]), buttons, seconds)
        reading = hand.reading(0.0)
        assert np.linalg.norm(reading.position - START.position) <= SPEC.reach_mm * (1 + 1e-15)
        fastest = math.sqrt(3) * SPEC.speed_mm_s * LONGEST_S
        assert np.linalg.norm(reading.position - before.position) <= fastest + 1e-12
        assert abs(reading.quaternion @ reading.quaternion - 1.0) < 1e-14
        assert reading.closure is not None
        assert 0.0 <= reading.closure <= 1.0
        before = reading


def test_one_button_closes_the_other_opens_and_both_hold() -> None:
    """0.5 s from open to closed: 0.1 s is a fifth; then the end stops it. Ten sums of 0.02."""
    assert moved(SPEC, STILL, STILL, 10, (1, 0)).reading(0.0).closure == pytest.approx(0.7, abs=1e-14)
    assert moved(SPEC, STILL, STILL, 10, (0, 1)).reading(0.0).closure == pytest.approx(0.3, abs=1e-14)
    assert moved(SPEC, STILL, STILL, 10, (1, 1)).reading(0.0).closure == 0.5
    assert moved(SPEC, STILL, STILL, 99, (1, 0)).reading(0.0).closure == 1.0


class AxisConvention(enum.StrEnum):
    HID_Z_UP = "hid_z_up"


class Mouse:
    """What pyspacemouse 2.1 documents of an open device."""

    def __init__(self, buttons: int) -> None:
        axes = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.0)
        self.state = SimpleNamespace(t=-1.0, buttons=[0] * buttons, **axes)
        self.fault: Exception | None = None
        self.closed = False

    def read(self) -> SimpleNamespace:
        if self.fault is not None:
            raise self.fault
        return self.state

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Any:
    module = ModuleType("pyspacemouse")
    found: Any = SimpleNamespace(mice=[], buttons=2, fault=None, asked=[])

    def open_(*, device: str | None, axis_convention: AxisConvention, nonblocking: bool) -> Mouse:
        found.asked.append((device, axis_convention, nonblocking))
        if found.fault is not None:
            raise found.fault
        print("a SpaceMouse found")
        found.mice.append(Mouse(found.buttons))
        return found.mice[-1]  # type: ignore[no-any-return]

    module.open = open_  # type: ignore[attr-defined]
    module.AxisConvention = AxisConvention  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pyspacemouse", module)
    return found


def test_the_cap_moves_its_instrument_and_no_other(library: Any) -> None:
    driver = open_spacemouse(SPEC, None, TOOLS, TICK_HZ, HOME)
    polling = Polling(driver)
    library.mice[0].state.x = 1.0
    library.mice[0].state.buttons[1] = 1
    # To the end of its reach, and no farther; the jaws are open by then.
    poses = polling.until(lambda poses: bool(poses.position[1, 0] >= HOME.position[1, 0] + 5.0 - 1e-9))
    np.testing.assert_allclose(poses.position[1], HOME.position[1] + 5.0 * FULL, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(poses.position[0], HOME.position[0])
    assert polling.until(lambda poses: bool(poses.closure[1] == 0.0)).closure[0] == 1.0
    driver.close()
    assert library.mice[0].closed
    assert library.asked == [(None, AxisConvention.HID_Z_UP, True)]


def test_a_mouse_pulled_out_freezes_its_instrument_which_goes_on_from_there(library: Any) -> None:
    driver = open_spacemouse(SPEC, None, TOOLS, TICK_HZ, HOME)
    polling = Polling(driver)
    library.mice[0].state.z = 1.0
    polling.until(lambda poses: bool(poses.position[1, 2] > HOME.position[1, 2] + 1.0))
    library.fault = RuntimeError("Device not found.")
    library.mice[0].fault = OSError("Failed to read from HID device: -1")
    polling.until(lambda poses: poses.valid.tolist() == [True, False])
    frozen = polling.last.position[1].copy()
    polling.until(lambda poses: "SpaceMouse: Device not found." in polling.reasons())
    assert library.mice[0].closed
    library.fault = None
    poses = polling.until(all_seen)
    driver.close()
    # What the last look before the fault added is not more than the speed allows in the longest look.
    np.testing.assert_allclose(poses.position[1], frozen, rtol=0, atol=SPEC.speed_mm_s * LONGEST_S)
    assert driver.summary()["reconnects"] == 1


def test_what_cannot_be_opened_is_one_line(library: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    library.fault = RuntimeError("HID API is probably not installed.")
    with pytest.raises(DeviceError, match=r"^SpaceMouse: HID API is probably not installed\.$"):
        open_spacemouse(SPEC, None, TOOLS, TICK_HZ, HOME)
    library.fault, library.buttons = None, 1
    with pytest.raises(DeviceError, match=r"^SpaceMouse: has 1 buttons; give"):
        open_spacemouse(SPEC, None, TOOLS, TICK_HZ, HOME)
    assert library.mice[0].closed
    with pytest.raises(ConfigError, match="the device moves right; the task has left"):
        open_spacemouse(SPEC, None, ("left",), TICK_HZ, HOME)
    monkeypatch.setitem(sys.modules, "pyspacemouse", None)
    with pytest.raises(ConfigError, match="needs a package that is not installed: pip install pyspacemouse"):
        open_spacemouse(SPEC, None, TOOLS, TICK_HZ, HOME)


def test_a_thread_of_a_mouse_ends_with_the_session(library: Any) -> None:
    driver = open_spacemouse(SPEC, None, TOOLS, TICK_HZ, HOME)
    library.mice[0].fault = OSError("gone")
    Polling(driver).until(lambda poses: not none_seen(poses))
    driver.close()
    assert "spacemouse" not in [thread.name for thread in threading.enumerate()]
