"""The nearest points of two convex bodies, checked by the condition that no other points are nearer."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.mechanics.closest_points import point_segment, point_triangle, segment_near_triangle, segment_segment

KINDS = ("even", "needle", "collapsed", "parallel", "one place")


def corners(kind: str, seed: int) -> np.ndarray:
    """Six places (6, 3) within ±1, ordinary or degenerate: a segment 0, 1, another 3, 4, a triangle 3, 4, 5."""
    x = np.random.default_rng(seed).uniform(-1.0, 1.0, (6, 3))
    if kind == "needle":
        x[5] = x[3] + 0.3 * (x[4] - x[3]) + 1e-9
    elif kind == "collapsed":
        x[5] = x[4] = x[3]
        x[1] = x[0]
    elif kind == "parallel":
        x[4] = x[3] + 2.0 * (x[1] - x[0])
    elif kind == "one place":
        x[:] = x[0]
    return x


places = st.builds(corners, st.sampled_from(KINDS), st.integers(0, 10**6))


def assert_nearest(first: np.ndarray, on_first: np.ndarray, second: np.ndarray, on_second: np.ndarray) -> None:
    """Two points of convex bodies are nearest exactly when no corner lies further towards the other body.

    For corners c of a body of size ≤ 4: (c - q)·(p - q) ≤ 0 (Boyd and Vandenberghe 2004, "Convex Optimization", 4.2.3).
    The tolerance: weights from a det of at least 1e-6 of its terms are off by ten roundings over 1e-6, 2e-9, which
    moves q by 8e-9 and the product by four times that; flatter ones are compared with the ends as well.
    """
    gap = on_first - on_second
    assert ((second - on_second) @ gap).max() <= 1e-7
    assert ((on_first - first) @ gap).max() <= 1e-7


@given(places)
def test_no_point_of_a_triangle_is_nearer(x: np.ndarray) -> None:
    d, b, c = point_triangle(*x[0], x, 3, 4, 5)
    foot = (1.0 - b - c) * x[3] + b * x[4] + c * x[5]
    assert min(b, c, 1.0 - b - c) >= -1e-15
    assert d == pytest.approx(np.sum((x[0] - foot) ** 2), rel=1e-9, abs=1e-28)
    assert_nearest(x[:1], x[0], x[3:6], foot)


@given(places)
def test_no_points_of_two_segments_are_nearer_and_it_is_the_same_the_other_way_round(x: np.ndarray) -> None:
    d, s, t = segment_segment(x, 0, 1, x, 3, 4)
    on_first, on_second = x[0] + s * (x[1] - x[0]), x[3] + t * (x[4] - x[3])
    assert 0.0 <= s <= 1.0
    assert 0.0 <= t <= 1.0
    assert d == pytest.approx(np.sum((on_first - on_second) ** 2), rel=1e-9, abs=1e-28)
    assert_nearest(x[:2], on_first, x[3:5], on_second)
    swapped, _, _ = segment_segment(x, 3, 4, x, 1, 0)
    # Squared distances up to 12, whose points were found along other ways; see assert_nearest for the 1e-8.
    assert swapped == pytest.approx(d, abs=1e-8)


def test_a_point_beside_a_segment_and_beyond_its_ends() -> None:
    x = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    assert point_segment(0.5, 3.0, 0.0, x, 0, 1) == (9.0, 0.25)
    assert point_segment(-1.0, 0.0, 0.0, x, 0, 1) == (1.0, 0.0)
    assert point_segment(4.0, 0.0, 1.0, x, 0, 1) == (5.0, 1.0)
    assert point_segment(0.0, 2.0, 0.0, x, 0, 0) == (4.0, 0.0)


@given(places)
def test_a_segment_is_near_a_triangle_when_a_point_of_it_is(x: np.ndarray) -> None:
    """With points every h along the segment, the least of their distances is between d and d + h / 2.

    So it is near at that distance, and not near at that distance less h / 2. The 1e-8 are of the point's distance.
    """
    steps = 500
    least = min(
        float(np.sqrt(point_triangle(*(x[0] + s * (x[1] - x[0])), x, 3, 4, 5)[0])) for s in np.linspace(0.0, 1.0, steps)
    )
    half = 0.5 * float(np.linalg.norm(x[1] - x[0])) / (steps - 1)
    assert segment_near_triangle(x, 0, 1, x, 3, 4, 5, least + 1e-8)
    if least - half > 2e-8:
        assert not segment_near_triangle(x, 0, 1, x, 3, 4, 5, least - half - 1e-8)


def test_a_segment_through_a_triangle_is_at_no_distance() -> None:
    x = np.array([[0.2, 0.2, 1.0], [0.3, 0.2, -1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert segment_near_triangle(x, 0, 1, x, 2, 3, 4, 1e-9)
    x[:2, 0] += 1.0
    assert not segment_near_triangle(x, 0, 1, x, 2, 3, 4, 0.1)
