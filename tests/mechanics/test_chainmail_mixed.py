"""ChainMail in several materials: the least move that satisfies all limits, along one axis; its error along several."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from volume_samples import SPACING, check_structure, cut_some, material, random_shape, seeds, worst_violation

from trainer.mechanics.chainmail_corrected import ROUNDING
from trainer.mechanics.volume import FREE, Volume, VolumeState, build, start, tack
from trainer.mechanics.volume_drag import drag

EPS = float(np.finfo(np.float32).eps)
SOFT, FIRM, STIFF = material(1.5, 0.5, 0.5, "soft"), material(1.1, 0.9, 0.1, "firm"), material(1.0, 1.0, 0.0, "stiff")


def mixed(labels: np.ndarray) -> Volume:
    return build(labels, SPACING, {1: SOFT, 2: FIRM, 3: STIFF})


def least_move(volume: Volume, state: VolumeState, held: int, to: np.ndarray) -> np.ndarray:
    """Displacements (3, n) of the least move that satisfies all limits, by Bellman and Ford: every link is asked again
    and again until none moves anything. Each component by itself, in float64."""
    labels = volume.labels.reshape(-1)
    a, b, low, high = [], [], [], []
    for axis in range(3):
        one = np.flatnonzero(state.links & (1 << 2 * axis))
        other = one + volume.strides[axis]
        ma, mb = volume.material_of[labels[one]], volume.material_of[labels[other]]
        both = (ma >= 0) & (mb >= 0)
        a.append(one[both])
        b.append(other[both])
        low.append(volume.low[ma[both], mb[both], 2 * axis])
        high.append(volume.high[ma[both], mb[both], 2 * axis])
    i, j = np.concatenate([*a, *b]), np.concatenate([*b, *a])
    least, most = np.concatenate([*low, *(-h for h in high)]), np.concatenate([*high, *(-v for v in low)])
    moves = ((state.links[j] & FREE) != 0) & (j != held)
    i, j, least, most = i[moves], j[moves], least[moves], most[moves]
    out = state.u.astype(np.float64)
    for c in range(3):
        u = out[c]
        up = to[c] >= u[held]
        u[held] = to[c]
        while True:
            asked = u[i] + (least if up else most)[:, c]
            before = u.copy()
            (np.maximum if up else np.minimum).at(u, j, asked)
            if np.array_equal(u, before):
                break
    return out


@pytest.mark.parametrize("method", ["largest first", "corrected"])
@pytest.mark.parametrize("axis", range(3))
@given(seeds)
def test_along_one_axis_it_is_the_least_move_that_satisfies_all_limits(axis: int, method: str, seed: int) -> None:
    """Rounding: sums along ways of at most n links in float32, and what correction leaves over at each."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(n) for n in rng.integers(1, 8, size=3))
    labels = random_shape(seed, (shape[0], shape[1], max(shape[2], 3)), float(rng.uniform(0, 0.4)), 0.0, soft=3)
    volume = mixed(labels)
    state = start(volume)
    cut_some(volume, state, seed, 0.1)
    soft = np.flatnonzero(labels)
    for _ in range(2):
        held = int(rng.choice(soft))
        to = state.u[:, held].astype(np.float64)
        to[axis] += rng.normal() * 2.0
        to = to.astype(np.float32).astype(np.float64)
        expected = least_move(volume, state, held, to)
        assert drag(volume, state, np.array([held]), to, method).method == method
        np.testing.assert_allclose(
            state.u, expected, atol=len(soft) * (EPS + ROUNDING) * max(1.0, float(np.abs(expected).max()))
        )
        check_structure(volume, state)


def test_the_stiff_way_around_is_taken_first() -> None:
    """A soft row of 9 whose ends hang on a stiff row beside it: pulled at one end by p, the stiff row goes along whole,
    and the soft row's far end with it, which plain lists along the row would have left behind."""
    labels = np.full((9, 2, 1), 3, np.uint8)
    labels[1:8, 1] = 1
    volume = build(labels, SPACING, {1: SOFT, 3: STIFF}, joined=[(1, 3)])
    state = start(volume)
    gone = np.flatnonzero(labels.reshape(-1) == 1)
    state.links[gone] &= np.uint8(0xFF ^ (1 << 3))  # the soft row hangs at its ends only
    state.links[gone - 1] &= np.uint8(0xFF ^ (1 << 2))
    drag(volume, state, np.array([0]), (1.0, 0.0, 0.0))
    u = state.u[0].reshape(9, 2)
    assert np.all(u[:, 0] == 1.0)
    assert np.all(u[[0, 8], 1] == 1.0)
    assert worst_violation(volume, state) <= 20 * (EPS + ROUNDING)


@given(seeds)
def test_corrected_it_is_the_least_move_along_all_axes_at_once(seed: int) -> None:
    """Each component by itself, in any shape. What may be left over: ROUNDING of the largest displacement at each link
    of a way, and the roundings of the sums."""
    rng = np.random.default_rng(seed)
    labels = random_shape(seed, tuple(int(n) for n in rng.integers(2, 8, size=3)), 0.3, 0.0, soft=3)
    volume = mixed(labels)
    state = start(volume)
    cut_some(volume, state, seed, 0.1)
    soft = np.flatnonzero(labels)
    for _ in range(2):
        held = int(rng.choice(soft))
        to = (state.u[:, held] + rng.normal(size=3) * 2.0).astype(np.float32).astype(np.float64)
        expected = least_move(volume, state, held, to)
        assert drag(volume, state, np.array([held]), to).method == "corrected"
        np.testing.assert_allclose(state.u, expected, atol=len(soft) * (EPS + ROUNDING) * float(np.abs(expected).max()))
        check_structure(volume, state)


def test_elements_pulled_different_ways_are_done_largest_first() -> None:
    volume = mixed(random_shape(1, (6, 6, 6), 0.0, 0.0, soft=3))
    state = start(volume)
    done = drag(volume, state, np.array([0, 215]), [(-2.0, 0.0, 0.0), (2.0, 0.0, 0.0)])
    assert done.method == "largest first"
    np.testing.assert_array_equal(state.u[0, [0, 215]], [-2.0, 2.0])


def test_several_axes_at_once_leave_this_much() -> None:
    """One order serves three systems of constraints. What it leaves over, in a block of 12³ of three materials in
    random places that is pulled by two element lengths along all axes: below half an element."""
    worst = 0.0
    for seed in range(20):
        volume = mixed(random_shape(seed, (12, 12, 12), 0.0, 0.0, soft=3))
        state = start(volume)
        held = np.array([6 * 144 + 6 * 12 + 6])
        drag(volume, state, held, 2.0 * np.array(SPACING) * (1.0, -1.0, 1.0), "largest first")
        worst = max(worst, worst_violation(volume, state))
    assert 0.0 < worst < 0.5 * min(SPACING)


def test_tissue_between_bones_does_not_move_them() -> None:
    labels = random_shape(3, (10, 10, 10), 0.1, 0.2, soft=2)
    volume = build(labels, SPACING, {1: SOFT, 2: FIRM})
    state = start(volume)
    soft = np.flatnonzero((labels == 1) | (labels == 2)).astype(np.int32)
    tack(state, soft[::10])
    drag(volume, state, soft[1:2], (5.0, 0.0, 0.0))
    assert not np.any(state.u[:, labels.reshape(-1) == 9])
    assert not np.any(state.u[:, soft[::10]])
    assert np.any(state.u)


def test_of_one_material_it_does_what_the_lists_do() -> None:
    """Two labels of the same material, pulled along one axis: order does not matter there."""
    labels = np.random.default_rng(0).integers(1, 3, size=(9, 9, 9)).astype(np.uint8)
    same = material()
    two, one = build(labels, SPACING, {1: same, 2: same}), build(np.ones_like(labels), SPACING, {1: same})
    states = [start(two), start(one)]
    for volume, state in zip((two, one), states, strict=True):
        drag(volume, state, np.array([364]), (0.9, 0.0, 0.0))
    np.testing.assert_allclose(states[0].u, states[1].u, atol=27 * (EPS + ROUNDING))
