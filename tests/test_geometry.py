"""Rotations and rigid transforms against their definitions and an independent implementation (scipy).

Tolerance everywhere: unit quaternions and rotation matrices have entries of at most 1; each of the formulas
makes fewer than 50 roundings of 1.1e-16 of such numbers, so results agree to 1e-14 (1e-13 for lengths of 10).
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from trainer import geometry
from trainer.geometry import Array, Rigid

TIGHT = 1e-14
NUMBER = st.floats(-10.0, 10.0, allow_subnormal=False)
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER).map(np.array)


@st.composite
def quaternions(draw: st.DrawFn) -> Array:
    q = np.array([draw(st.floats(-1.0, 1.0, allow_subnormal=False)) for _ in range(4)])
    length = np.linalg.norm(q)
    assume(length > 0.1)
    return np.asarray(q / length)


def scipy_matrix(q: Array) -> Array:
    return np.asarray(Rotation.from_quat(np.roll(q, -1)).as_matrix())


@given(quaternions())
def test_a_quaternion_and_its_matrix_are_the_same_rotation(q: Array) -> None:
    matrix = geometry.matrix_from_quaternion(q)
    np.testing.assert_allclose(matrix, scipy_matrix(q), atol=TIGHT)
    back = geometry.quaternion_from_matrix(matrix)
    np.testing.assert_allclose(back * np.sign(back @ q), q, atol=TIGHT)


@pytest.mark.parametrize("diagonal", [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_half_turns_have_a_quaternion(diagonal: tuple[int, int, int]) -> None:
    """Where the trace is -1 the textbook formula divides by zero; the first non-zero number is positive."""
    q = geometry.quaternion_from_matrix(np.diag(np.array(diagonal, dtype=float)))
    assert sorted(q.tolist()) == [0.0, 0.0, 0.0, 1.0]
    np.testing.assert_array_equal(geometry.matrix_from_quaternion(q), np.diag(diagonal))


@given(quaternions(), quaternions(), VECTOR)
def test_the_product_turns_by_the_second_and_then_by_the_first(a: Array, b: Array, v: Array) -> None:
    product = geometry.quaternion_multiply(a, b)
    expected = scipy_matrix(a) @ (scipy_matrix(b) @ v)
    np.testing.assert_allclose(geometry.matrix_from_quaternion(product) @ v, expected, atol=1e-13)


@given(quaternions())
def test_the_conjugate_is_the_inverse(q: Array) -> None:
    one = geometry.quaternion_multiply(q, geometry.quaternion_conjugate(q))
    np.testing.assert_allclose(one, [1.0, 0.0, 0.0, 0.0], atol=TIGHT)


@given(VECTOR, st.floats(-6.0, 6.0), VECTOR)
def test_axis_and_angle_follow_rodrigues_formula(axis: Array, angle: float, v: Array) -> None:
    """v' = v cos a + (k × v) sin a + k (k · v)(1 - cos a)."""
    assume(np.linalg.norm(axis) > 1e-3)
    k = axis / np.linalg.norm(axis)
    expected = v * math.cos(angle) + np.cross(k, v) * math.sin(angle) + k * (k @ v) * (1.0 - math.cos(angle))
    found = geometry.matrix_from_quaternion(geometry.quaternion_from_axis_angle(axis, angle)) @ v
    np.testing.assert_allclose(found, expected, atol=1e-13)


@given(st.tuples(*[st.floats(-180.0, 180.0)] * 3))
def test_degrees_in_a_file_turn_about_the_fixed_axes_x_then_y_then_z(xyz: tuple[float, float, float]) -> None:
    expected = Rotation.from_euler("xyz", xyz, degrees=True).as_matrix()
    found = geometry.matrix_from_quaternion(geometry.quaternion_from_euler_deg(xyz))
    np.testing.assert_allclose(found, expected, atol=TIGHT)


@given(VECTOR, VECTOR)
def test_axes_become_the_columns_of_the_rotation(x: Array, y: Array) -> None:
    """First column along x, second in the plane of x and y on y's side, third x × y.

    The sine of the angle between x and y is at least 1e-2 here, which loses two digits.
    """
    assume(min(np.linalg.norm(x), np.linalg.norm(y)) > 0.1)
    normal = np.cross(x, y)
    assume(np.linalg.norm(normal) > 1e-2 * np.linalg.norm(x) * np.linalg.norm(y))
    matrix = geometry.matrix_from_quaternion(geometry.quaternion_from_axes(x, y))
    np.testing.assert_allclose(matrix[:, 0], x / np.linalg.norm(x), atol=1e-12)
    np.testing.assert_allclose(matrix[:, 2], normal / np.linalg.norm(normal), atol=1e-12)
    assert matrix[:, 1] @ y > 0.0


def angle_between(a: Array, b: Array) -> float:
    """By the chord, which keeps its digits at small angles where the arc cosine does not."""
    chord = min(float(np.linalg.norm(a - b)), float(np.linalg.norm(a + b)))
    return 4.0 * math.asin(min(0.5 * chord, 1.0))


@given(quaternions(), quaternions(), st.floats(0.0, 1.0))
def test_slerp_turns_at_constant_speed_the_short_way(a: Array, b: Array, fraction: float) -> None:
    """The angle gone is ``fraction`` of the whole, at most 180°. Near 180° the way is not unique.

    An arc cosine of a number near 1 is right to the square root of its rounding: 1e-16 becomes 1e-8 rad, and
    below 1e-6 rad the chord stands for the arc, so 3e-8 rad is allowed.
    """
    whole = angle_between(a, b)
    assume(whole < 3.1)
    found = geometry.slerp(a, b, fraction)
    assert abs(np.linalg.norm(found) - 1.0) < TIGHT
    assert angle_between(a, found) == pytest.approx(fraction * whole, abs=3e-8)
    assert angle_between(found, b) == pytest.approx((1.0 - fraction) * whole, abs=3e-8)


def test_slerp_works_on_rows() -> None:
    a = geometry.quaternion_from_euler_deg([0.0, 0.0, 0.0])
    b = geometry.quaternion_from_euler_deg([0.0, 0.0, 90.0])
    found = geometry.slerp(np.stack([a, a]), np.stack([b, -b]), np.array([0.5, 0.5]))
    expected = geometry.quaternion_from_euler_deg([0.0, 0.0, 45.0])
    np.testing.assert_allclose(found, np.stack([expected, expected]), atol=TIGHT)


@given(quaternions(), VECTOR, quaternions(), VECTOR, VECTOR)
def test_rigid_transforms_cancel_as_their_names_say(qa: Array, pa: Array, qb: Array, pb: Array, point: Array) -> None:
    """a_from_b @ b_from_c takes c to a; a_from_b and its inverse cancel. Lengths to 30 mm: 1e-13."""
    a_from_b, b_from_c = Rigid(pa, qa), Rigid(pb, qb)
    np.testing.assert_allclose((a_from_b @ b_from_c).apply(point), a_from_b.apply(b_from_c.apply(point)), atol=1e-13)
    np.testing.assert_allclose(a_from_b.inverse().apply(a_from_b.apply(point)), point, atol=1e-13)
    np.testing.assert_allclose(a_from_b.rotate(point), a_from_b.apply(point) - pa, atol=1e-13)


def test_identity_moves_nothing() -> None:
    points = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(Rigid.identity().apply(points), points)


@given(quaternions(), VECTOR, st.integers(0, 2**32 - 1))
def test_the_fitted_rotation_is_the_one_that_was_made(q: Array, shift: Array, seed: int) -> None:
    """Twelve random points are far from a line, so singular values lie within a factor of about 10: 1e-13."""
    rest = np.random.default_rng(seed).normal(size=(12, 3))
    now = Rigid(shift, q).apply(rest)
    np.testing.assert_allclose(geometry.fit_rotation(rest, now), scipy_matrix(q), atol=1e-13)


def test_the_fitted_rotation_is_never_a_reflection() -> None:
    rest = np.random.default_rng(1).normal(size=(12, 3))
    fitted = geometry.fit_rotation(rest, rest * [1.0, 1.0, -1.0])
    assert np.linalg.det(fitted) == pytest.approx(1.0, abs=1e-13)


def test_weights_choose_which_points_the_rotation_fits() -> None:
    """Half of the points were turned by 90°, the others stayed: those with weight decide."""
    rest = np.random.default_rng(2).normal(size=(20, 3))
    turn = geometry.matrix_from_quaternion(geometry.quaternion_from_euler_deg([0.0, 0.0, 90.0]))
    now = rest.copy()
    now[:10] = rest[:10] @ turn.T
    weights = np.repeat([1.0, 0.0], 10)
    np.testing.assert_allclose(geometry.fit_rotation(rest, now, weights), turn, atol=1e-13)


@given(VECTOR, VECTOR)
def test_cross_is_the_cross_product(a: Array, b: Array) -> None:
    np.testing.assert_array_equal(geometry.cross(a, b), np.cross(a, b))


def test_a_zero_vector_has_no_direction() -> None:
    with pytest.raises(ValueError, match="zero length"):
        geometry.unit([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
