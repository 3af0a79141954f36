"""Laws of sliding: enough thread in every span, least motion, order, hard constraints, pull-out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog

from trainer.geometry import Array
from trainer.mechanics.thread import Slid, ThreadModel, break_at, slide

MODEL = ThreadModel(4.0, 0.5, 201)  # arcs 4 .. 104 mm
ROUNDING = 1e-9  # mm: sums of at most 10 distances of some 10 mm are exact to 1e-14; leaves room for the solver's


def on_a_line(places: list[float]) -> Array:
    points = np.zeros((len(places), 3))
    points[:, 0] = places
    return points


def slid_at(arcs: list[float], places: list[float], hard: list[bool]) -> Slid:
    return slide(MODEL, np.array(arcs), on_a_line(places), np.array(hard, dtype=bool), MODEL.whole())


def least_sliding(arcs: Array, distances: Array, hard: NDArray[np.bool_]) -> float | None:
    """Least sum |ds| with s_{k+1} - s_k >= D_k by linear programming over (s, t), t >= |s - arcs|."""
    c = len(arcs)
    rows, limits = [], []
    for k in range(c - 1):
        row = np.zeros(2 * c)
        row[k], row[k + 1] = 1.0, -1.0
        rows.append(row)
        limits.append(-distances[k])
    for k in range(c):
        for sign in (1.0, -1.0):
            row = np.zeros(2 * c)
            row[k], row[c + k] = sign, -1.0
            rows.append(row)
            limits.append(sign * arcs[k])
    bounds = [(a, a) if h else (None, None) for a, h in zip(arcs, hard, strict=True)] + [(0.0, None)] * c
    found = linprog(np.concatenate([np.zeros(c), np.ones(c)]), A_ub=np.array(rows), b_ub=limits, bounds=bounds)
    return float(found.fun) if found.status == 0 else None


@settings(max_examples=150, deadline=None, derandomize=True)
@given(c=st.integers(1, 9), seed=st.integers(0, 2**32 - 1), spread=st.sampled_from([0.5, 2.0, 4.0]))
def test_sliding_is_feasible_ordered_and_least(c: int, seed: int, spread: float) -> None:
    """Against a linear program: same total sliding; hard arcs untouched; each span has its thread.

    Both ends are kept out of reach so that nothing is pulled out; where the program finds no solution
    there must be a shortage, and the other way round.
    """
    rng = np.random.default_rng(seed)
    arcs = np.sort(rng.uniform(45.0, 60.0, c))
    points = np.cumsum(rng.normal(0.0, spread / np.sqrt(3.0), (c, 3)), axis=0)
    hard = rng.random(c) < 0.25
    distances = np.linalg.norm(np.diff(points, axis=0), axis=1)
    slid = slide(MODEL, arcs, points, hard, MODEL.whole())
    assert not slid.pulled_out.any()
    assert (np.diff(slid.arc) >= -ROUNDING).all()
    np.testing.assert_array_equal(slid.arc[hard], arcs[hard])
    best = least_sliding(arcs, distances, hard)
    if best is None:
        assert slid.shortage.max() > 0.0
    else:
        assert not slid.shortage.any()
        assert (np.diff(slid.arc) >= distances - ROUNDING).all()
        # the program's own tolerance is 1e-7 per constraint
        assert np.abs(slid.arc - arcs).sum() == pytest.approx(best, abs=1e-5)
    again = slide(MODEL, slid.arc, points, hard, MODEL.whole())
    np.testing.assert_allclose(again.arc, slid.arc, rtol=0.0, atol=ROUNDING)  # enough is enough
    mirrored = slide(MODEL, (108.0 - arcs)[::-1], points[::-1], hard[::-1], MODEL.whole())
    np.testing.assert_allclose((108.0 - mirrored.arc)[::-1], slid.arc, rtol=0.0, atol=ROUNDING)


def test_a_pull_draws_thread_from_the_nearest_slack_only() -> None:
    """Grip at arc 10; its hole at arc 12 moves to 3 mm away: 1 mm comes from the span behind, which had 2 to spare."""
    slid = slid_at([10.0, 12.0, 15.0], [0.0, 3.0, 4.0], [True, False, False])
    np.testing.assert_allclose(slid.arc, [10.0, 13.0, 15.0])
    # With 0.5 mm to spare there, the next hole gives the rest from the free end.
    slid = slid_at([10.0, 12.0, 13.5], [0.0, 3.0, 4.0], [True, False, False])
    np.testing.assert_allclose(slid.arc, [10.0, 13.0, 14.0])


def test_two_holes_drawn_apart_share_the_sliding() -> None:
    """Nothing tells the sides apart, so 1 mm too little is drawn half from either."""
    slid = slid_at([20.0, 22.0], [0.0, 3.0], [False, False])
    np.testing.assert_allclose(slid.arc, [19.5, 22.5])


def test_between_two_grips_too_far_apart_the_holes_share_the_lack() -> None:
    """8 mm of thread over 2 + 6 + 2 = 10 mm: lacking 2, every span has 0.8 of its distance; beyond, nothing moves."""
    slid = slid_at([10.0, 11.0, 17.9, 18.0, 30.0], [0.0, 2.0, 8.0, 10.0, 11.0], [True, False, False, True, False])
    np.testing.assert_allclose(slid.arc, [10.0, 11.6, 16.4, 18.0, 30.0])
    np.testing.assert_allclose(slid.shortage, [2.0, 0.0, 0.0, 0.0, 0.0], atol=1e-12)


def test_the_tail_is_pulled_out_of_the_last_hole_only_when_it_must() -> None:
    """The tail is 1 mm beyond the outer hole: a 2 mm pull frees it, and the inner hole keeps its own need."""
    places = [0.0, 6.0, 7.0]
    slid = slid_at([100.0, 102.0, 103.0], places, [False, False, False])  # all free: the slack side gives
    assert not slid.pulled_out.any()
    slid = slid_at([99.5, 102.0, 103.0], [0.0, 4.0, 5.5], [True, False, False])
    np.testing.assert_array_equal(slid.pulled_out, [False, False, True])
    np.testing.assert_allclose(slid.arc, [99.5, 103.5, 104.0])
    slid = slid_at([99.5, 102.0, 103.0], [0.0, 6.0, 7.0], [True, False, False])
    np.testing.assert_array_equal(slid.pulled_out, [False, True, True])


def test_the_first_end_can_be_pulled_out_too() -> None:
    slid = slid_at([5.0, 8.0], [0.0, 5.0], [False, True])
    np.testing.assert_array_equal(slid.pulled_out, [True, False])
    np.testing.assert_allclose(slid.arc, [4.0, 8.0])


def test_pieces_slide_on_their_own_and_what_is_not_on_the_thread_stays() -> None:
    """A break between two grips ends the shortage; a hole on the needle (arc 2) and on the lost link stay."""
    arcs, points = np.array([2.0, 10.0, 12.2, 14.0]), on_a_line([0.0, 5.0, 10.0, 20.0])
    hard = np.array([False, True, False, True])
    assert slide(MODEL, arcs, points, hard, MODEL.whole()).shortage[1] == pytest.approx(11.0)
    slid = slide(MODEL, arcs, points, hard, break_at(MODEL, MODEL.whole(), 12.2))
    np.testing.assert_array_equal(slid.arc, arcs)
    assert not slid.shortage.any()
    assert not slid.pulled_out.any()
