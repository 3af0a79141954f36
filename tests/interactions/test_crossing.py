"""Where a moving point goes through a moving triangle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.interactions.crossing import first_crossing, nearest_on_surface

TRIANGLE = np.array([[0, 1, 2]], dtype=np.int32)
NONE = np.zeros(1, dtype=np.bool_)
finite = st.floats(-1.0, 1.0, allow_nan=False)
vectors = st.tuples(finite, finite, finite).map(np.array)


@given(
    weights=st.tuples(*[st.floats(0.01, 1.0)] * 3),
    fraction=st.floats(0.01, 0.99),
    moves=st.tuples(vectors, vectors, vectors),
)
def test_a_crossing_is_found_where_and_when_it_was_put(
    weights: tuple[float, float, float], fraction: float, moves: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    """A point sent through a chosen place of a moving triangle at a chosen time, from above to below.

    The corners move by at most 0.2 mm while the point falls 2 mm, so that it crosses once. Bisection leaves the time
    within 2**-50, and place and weights follow within 1e-9 on a triangle of 1 mm.
    """
    x0 = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    x1 = x0 + 0.1 * np.array(moves) / np.sqrt(3.0)
    w = np.array(weights) / sum(weights)
    there = w @ (x0 + fraction * (x1 - x0))
    fall = np.array([0.0, 0.0, -2.0])
    p0, p1 = there - fraction * fall, there + (1.0 - fraction) * fall
    hit = first_crossing(p0, p1, x0, x1, TRIANGLE, NONE)
    assert hit is not None
    triangle, at, inwards, found = hit
    assert (triangle, inwards) == (0, True)
    assert at == pytest.approx(fraction, abs=1e-9)
    assert found == pytest.approx(w, abs=1e-8)
    back = first_crossing(p1, p0, x1, x0, TRIANGLE, NONE)
    assert back is not None
    assert back[2] is False
    assert back[1] == pytest.approx(1.0 - fraction, abs=1e-9)


@given(turn=st.floats(0.0, 6.3), shift=vectors, along=st.floats(0.0, 1.0))
def test_nothing_slips_between_two_triangles(turn: float, shift: np.ndarray, along: float) -> None:
    """A point sent exactly through the common edge of two triangles, anywhere in space, goes through one of them."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
    )
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.2], [1.0, -1.0, 0.1]]) @ rotation.T + 1000.0 * shift
    triangles = np.array([[0, 1, 2], [1, 0, 3]], dtype=np.int32)
    normal = np.cross(x[1] - x[0], x[2] - x[0])
    edge = x[0] + along * (x[1] - x[0])
    hit = first_crossing(edge + 0.3 * normal, edge - 0.3 * normal, x, x, triangles, np.zeros(2, dtype=np.bool_))
    assert hit is not None


def test_a_touch_that_turns_back_is_no_crossing() -> None:
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    above, aside = np.array([0.2, 0.2, 0.5]), np.array([2.0, 2.0, 0.5])
    assert first_crossing(above, np.array([0.3, 0.3, 0.1]), x, x, TRIANGLE, NONE) is None
    assert first_crossing(aside, aside - [0.0, 0.0, 1.0], x, x, TRIANGLE, NONE) is None
    assert first_crossing(above, above - [0.0, 0.0, 1.0], x, x, TRIANGLE, ~NONE) is None


def test_a_surface_that_overtakes_a_resting_point_crosses_it() -> None:
    """The wall springs back over a tip that stands still: half-way up, at half of the motion, from below."""
    x = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 1.0, -1.0]])
    rest = np.array([0.25, 0.25, 0.0])
    hit = first_crossing(rest, rest, x, x + np.array([0.0, 0.0, 2.0]), TRIANGLE, NONE)
    assert hit is not None
    assert hit[1] == pytest.approx(0.5)
    assert hit[2] is True


@given(p=vectors)
def test_the_nearest_place_of_a_triangle_is_nearer_than_any_other(p: np.ndarray) -> None:
    """Compared with 325 places spread over the triangle; rounding 1e-12."""
    x = np.array([[0.0, 0.0, 0.0], [0.9, 0.1, 0.0], [0.2, 0.8, 0.3]])
    _, weights = nearest_on_surface(p, x, TRIANGLE)
    assert weights.sum() == pytest.approx(1.0)
    assert np.all(weights >= -1e-12)
    grid = [(i / 24, j / 24) for i in range(25) for j in range(25 - i)]
    others = min(float(np.linalg.norm((1 - b - c) * x[0] + b * x[1] + c * x[2] - p)) for b, c in grid)
    assert np.linalg.norm(weights @ x - p) <= others + 1e-12
