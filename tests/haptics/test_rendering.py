"""Verification of the rendered force: over a press and release a wall gives nothing, and at rest it keeps its force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.geometry import Array, Rigid
from trainer.haptics.rendering import CHARGE, new_state, render
from trainer.mechanics.density_field import DensityField, density_field, force_at


def wall(stiffness: float) -> DensityField:
    rigid = np.zeros((16, 16, 32), dtype=bool)
    rigid[:, :, :16] = True
    return density_field(rigid, (0.5, 0.5, 0.5), Rigid.identity(), stiffness, 1e6)


def work_on_the_hand(field: DensityField, path: Array) -> tuple[float, Array]:
    """Sum of each held force times the way until the next one, mN mm, and all forces (n, 3)."""
    state = new_state()
    forces = []
    for tip in path:
        render(field.density, field.constants, tip, state)
        forces.append(state[:3].copy())
    return float(np.sum(np.array(forces[:-1]) * np.diff(path, axis=0))), np.array(forces)


def press(depth: float, period_s: float, sideways: float = 0.0) -> Array:
    """From 2 mm above the wall's plane into it and back, (n, 3) at 1 kHz."""
    t = np.arange(0.0, period_s, 1e-3)
    z = 7.75 + 2.0 - (2.0 + depth) * 0.5 * (1.0 - np.cos(2.0 * np.pi * t / period_s))
    return np.stack([4.0 + sideways * np.sin(2.0 * np.pi * t / period_s), np.full(len(t), 4.0), z], axis=1)


@given(st.floats(0.3, 4.0), st.floats(0.05, 2.0), st.floats(100.0, 20_000.0), st.floats(0.0, 2.0))
def test_a_press_and_release_gives_the_hand_no_energy(
    depth: float, period: float, stiffness: float, side: float
) -> None:
    """The work of the held forces on the hand is not positive, whatever speed, depth and stiffness.

    Cosines at 1 kHz: outwards each step is at most twice the one before but for the first after the turn, which is
    paid from what the way in has put in. Rounding: thousands of products of some 1e5 mN mm at 1e-16.
    """
    path = press(depth, period, side)
    work, _ = work_on_the_hand(wall(stiffness), path)
    assert work <= 1e-6


def test_without_the_count_the_same_press_gives_energy() -> None:
    """What the count is for: the plain field, each force held for its period, gives more than it takes.

    Per step the held force lags by half a step on both ways: Σ K Δz² / 2 twice, here above 1 mN mm.
    """
    field, path = wall(2000.0), press(1.0, 0.2)
    force, direction = np.zeros(3), np.zeros(3)
    plain = []
    for tip in path:
        force_at(field.density, field.constants, tip, force, direction)
        plain.append(force.copy())
    assert np.sum(np.array(plain[:-1]) * np.diff(path, axis=0)) > 1.0
    assert work_on_the_hand(field, path)[0] <= 0.0


def test_on_the_way_in_and_at_rest_the_force_is_the_fields() -> None:
    """Nothing is taken from the force of a hand that presses or holds still."""
    field = wall(500.0)
    path = press(1.0, 1.0)[:500]
    path = np.concatenate([path, np.repeat(path[-1:], 100, axis=0)])
    _, rendered = work_on_the_hand(field, path)
    force, direction = np.zeros(3), np.zeros(3)
    for tip, got in zip(path, rendered, strict=True):
        force_at(field.density, field.constants, tip, force, direction)
        np.testing.assert_array_equal(got, force)
    assert rendered[-1, 2] > 100.0


def test_a_tip_that_begins_inside_is_not_flung_out() -> None:
    field = wall(500.0)
    path = np.linspace([4.0, 4.0, 7.5], [4.0, 4.0, 9.5], 200)
    work, forces = work_on_the_hand(field, path)
    assert work == pytest.approx(0.0, abs=1e-12)
    assert np.abs(forces).max() == 0.0


def test_what_was_put_in_is_spent_when_the_tip_is_out() -> None:
    field, state = wall(500.0), new_state()
    for tip in press(2.0, 0.5):
        render(field.density, field.constants, tip, state)
    assert state[CHARGE] == 0.0
