"""Touched points tell where the scene is: to 0.05 mm with a tracker's noise, and not at all where they cannot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.calibration import CalibrationError
from trainer.drivers import touched_points
from trainer.geometry import (
    Array,
    Rigid,
    matrix_from_quaternion,
    quaternion_from_axis_angle,
    quaternion_from_euler_deg,
)

#: Scatter of a resting sensor, mm and axis: the largest within 2.5 s that the real recording in ../shared shows, 0.06;
#: and the step of a miniBIRD's position words at 36 inches full scale, 36 · 25.4 / 8192.
NOISE_MM = 0.06
STEP_MM = 36 * 25.4 / 8192

#: A phantom: corners of a box and middles of its edges, mm.
PHANTOM = np.array([[x, y, z] for x in (0, 50, 100) for y in (0, 80) for z in (0, 60)], dtype=np.float64)


def somewhere(rng: np.random.Generator) -> Rigid:
    """Any rotation, up to 300 mm away."""
    q = rng.normal(size=4)
    return Rigid(rng.uniform(-300, 300, 3), q / np.linalg.norm(q))


def touched(scene_from_device: Rigid, known: Array, rng: np.random.Generator, readings: int) -> tuple[Array, Array]:
    """Readings of known points: with noise, in steps of the tracker's words."""
    exact = np.repeat(scene_from_device.inverse().apply(known), readings, axis=0)
    noisy = exact + rng.normal(scale=NOISE_MM, size=exact.shape)
    return np.round(noisy / STEP_MM) * STEP_MM, np.repeat(known, readings, axis=0)


def off(found: Rigid, true: Rigid, places: Array) -> Array:
    """How far ``places`` (n, 3) of the scene are carried wrong, mm."""
    return np.asarray(np.linalg.norm(found.apply(true.inverse().apply(places)) - places, axis=1))


def test_without_noise_the_transform_is_found() -> None:
    """Coordinates below 500 mm, a dozen roundings of 1e-16 each: 1e-11."""
    true = somewhere(np.random.default_rng(0))
    found = touched_points.fit(true.inverse().apply(PHANTOM), PHANTOM)
    assert off(found.scene_from_device, true, PHANTOM).max() < 1e-11
    assert found.residual_mm < 1e-11


def test_with_a_tracker_s_noise_every_place_of_the_phantom_is_within_a_twentieth_of_a_millimetre() -> None:
    """12 points of 30 readings each. A reading's error per axis is that of noise and step, s = √(0.06² + 0.1116²/12);
    a point's mean has s / √30. Six parameters fitted to 3 · 12 numbers leave, at the points, a mean square error of
    6 / 12 of that: 0.0088 mm rms. The rms over 100 trials of 6 numbers each has a relative sd of 1 / √(2 · 600), 3 %:
    five of them are allowed. The claim itself, 0.05 mm at the worst point of the worst trial, is 5.7 times the rms.
    """
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(100):
        true = somewhere(rng)
        found = touched_points.fit(*touched(true, PHANTOM, rng, readings=30))
        errors.append(off(found.scene_from_device, true, PHANTOM))
    expected = np.sqrt((NOISE_MM**2 + STEP_MM**2 / 12) / 30 * 6 / 12)
    assert np.max(errors) < 0.05
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(expected, rel=0.15)


def test_the_residual_is_the_error_of_a_touch() -> None:
    """Σ|r|² has 3 n - 6 degrees of freedom, so √(Σ|r|² / (n - 2)) estimates √3 s for any n, three included.

    Over 400 trials of n = 3 (3 degrees of freedom each) the mean square has a relative sd of √(2 / 1200), 4 %: 20 %
    are five of them.
    """
    rng = np.random.default_rng(2)
    for n, trials in ((3, 400), (12, 50)):
        squares = []
        for _ in range(trials):
            true = somewhere(rng)
            readings = true.inverse().apply(PHANTOM[:n]) + rng.normal(scale=0.1, size=(n, 3))
            squares.append(touched_points.fit(readings, PHANTOM[:n]).residual_mm ** 2)
        assert np.mean(squares) == pytest.approx(3 * 0.1**2, rel=0.2)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(3, 20), length=st.floats(5.0, 300.0))
def test_points_on_a_line_are_refused_however_noisy_their_touches(seed: int, n: int, length: float) -> None:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    along = length * np.arange(n)[:, None] / (n - 1)
    known = rng.uniform(-50, 50, 3) + along * direction / np.linalg.norm(direction)
    device = somewhere(rng).apply(known) + rng.normal(scale=NOISE_MM, size=known.shape)
    with pytest.raises(CalibrationError, match="the points lie on a line, as they are known: spread"):
        touched_points.fit(device, known)


def test_touches_on_a_line_are_refused_even_if_the_points_are_said_to_be_elsewhere() -> None:
    device = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0]])
    with pytest.raises(CalibrationError, match="the points lie on a line, as they were touched"):
        touched_points.fit(device, PHANTOM[:4])


def test_a_point_a_fifth_of_the_length_aside_is_enough() -> None:
    """Of 0, 50, 100 mm with the middle one 40 mm aside: spread 40.8 mm along, 18.9 mm across."""
    known = np.array([[0.0, 0, 0], [50, 40, 0], [100, 0, 0]])
    np.testing.assert_allclose(touched_points.spread(known), [40.82, 18.86, 0.0], atol=5e-3)
    touched_points.fit(known, known)


@pytest.mark.parametrize("known", [PHANTOM[:2], PHANTOM[[0, 1, 0, 1]]], ids=["two", "two, again and again"])
def test_fewer_than_three_different_points_are_refused(known: Array) -> None:
    with pytest.raises(CalibrationError, match="2 different points were touched; touch three or more"):
        touched_points.fit(known, known)


def test_one_point_touched_wrong_is_refused_and_named() -> None:
    """12 points, one touched 10 mm off: a residual of at most 10 / √10 = 3.2 mm, and at that point the worst."""
    device = PHANTOM.copy()
    device[7, 2] += 10.0
    with pytest.raises(CalibrationError, match=r"residual [23]\.\d\d mm, .* worst at scene point \(50, 80, 60\)"):
        touched_points.fit(device, PHANTOM)


def test_mirrored_coordinates_are_refused() -> None:
    """No rotation is a reflection, and a solid phantom tells them apart."""
    with pytest.raises(CalibrationError, match="the points do not fit"):
        touched_points.fit(PHANTOM * [1, 1, -1], PHANTOM)


def test_a_point_counts_once_however_often_it_was_touched() -> None:
    """Twice at one point, 0.2 mm up and down, is the same as once in the middle, to rounding."""
    twice = np.concatenate([PHANTOM, PHANTOM[:1], PHANTOM[:1]])
    device = twice.copy()
    device[-2, 2] += 0.2
    device[-1, 2] -= 0.2
    found = touched_points.fit(device, twice)
    assert (found.points, found.residual_mm < 1e-12) == (12, True)


@given(st.tuples(*[st.floats(-180, 180)] * 3), st.sampled_from([None, 90.0, -90.0]))
def test_angles_in_a_file_give_the_rotation_back(angles: tuple[float, float, float], level: float | None) -> None:
    """Also where x and z turn about the same axis. Where y is within 1e-9 rad of a quarter turn, its cosine is dropped
    from two entries of the matrix; elsewhere rounding of 1e-16 is divided by that cosine: 1e-7 at the worst.
    """
    x, y, z = angles
    q = quaternion_from_euler_deg((x, y if level is None else level, z))
    again = quaternion_from_euler_deg(touched_points.euler_deg(q))
    np.testing.assert_allclose(matrix_from_quaternion(again), matrix_from_quaternion(q), rtol=0, atol=2e-7)


def test_the_axes_of_the_angles_are_those_of_toml_files() -> None:
    q = quaternion_from_axis_angle([1, 0, 0], np.radians(30))
    np.testing.assert_allclose(touched_points.euler_deg(q), [30, 0, 0], rtol=0, atol=1e-12)
