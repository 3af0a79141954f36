"""The needle's arc: frame, arc length, tangents and nearest points."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainer.instruments.needle import Needle, needle_closest, needle_point, needle_tangent

NEEDLE = Needle(1.5, 2.0 * math.pi * 1.5 * 3.0 / 8.0)


def test_frame_at_the_tip() -> None:
    np.testing.assert_array_equal(needle_point(NEEDLE, 0.0), np.zeros(3))
    np.testing.assert_array_equal(needle_tangent(NEEDLE, 0.0), [1.0, 0.0, 0.0])
    quarter = needle_point(NEEDLE, 0.5 * math.pi * NEEDLE.radius)
    np.testing.assert_allclose(quarter, [-1.5, 1.5, 0.0], atol=1e-15)


def test_points_lie_on_the_circle_and_tangents_point_to_the_tip() -> None:
    """|p - c| = r, and dp/ds = -t: the central difference over h is off by h^2 / (6 r^2) < 1e-9."""
    h = 1e-4
    for s in np.linspace(h, NEEDLE.length, 20):
        assert np.linalg.norm(needle_point(NEEDLE, s) - [0.0, 1.5, 0.0]) == pytest.approx(1.5, abs=1e-14)
        slope = (needle_point(NEEDLE, s + h) - needle_point(NEEDLE, s - h)) / (2.0 * h)
        np.testing.assert_allclose(needle_tangent(NEEDLE, s), -slope, atol=1e-9)


def test_closest_agrees_with_dense_sampling() -> None:
    """2000 samples: a sampled distance exceeds the true one by at most half a spacing."""
    arcs = np.linspace(0.0, NEEDLE.length, 2001)
    samples = np.array([needle_point(NEEDLE, s) for s in arcs])
    for query in np.random.default_rng(0).normal(0.0, 2.0, (300, 3)):
        distance, s = needle_closest(NEEDLE, query)
        assert distance == pytest.approx(np.linalg.norm(needle_point(NEEDLE, s) - query), abs=1e-14)
        sampled = np.linalg.norm(samples - query, axis=1).min()
        assert distance <= sampled + 1e-14
        assert sampled <= distance + 0.5 * arcs[1]


def test_closest_to_its_own_points_ends_and_axis() -> None:
    for s in np.linspace(0.0, NEEDLE.length, 11):
        assert needle_closest(NEEDLE, needle_point(NEEDLE, s)) == pytest.approx((0.0, s), abs=1e-14)
    assert needle_closest(NEEDLE, np.array([2.0, 0.0, 0.0])) == (2.0, 0.0)
    beyond = needle_point(NEEDLE, NEEDLE.length) - 0.3 * needle_tangent(NEEDLE, NEEDLE.length)
    assert needle_closest(NEEDLE, beyond) == pytest.approx((0.3, NEEDLE.length))
    assert needle_closest(NEEDLE, np.array([0.0, 1.5, 2.0])) == pytest.approx((2.5, 0.0))


def test_impossible_needles_are_named() -> None:
    for radius, length in ((0.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (1.0, 0.0), (1.0, 6.3), (1.0, math.nan)):
        with pytest.raises(ValueError, match="needle"):
            Needle(radius, length)
