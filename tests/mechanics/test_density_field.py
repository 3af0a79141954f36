"""Verification of the haptic density field: the paper's formula on a plane and a sphere, continuity, and the edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.geometry import Array, Rigid, quaternion_from_axis_angle
from trainer.mechanics.density_field import REACH, WEIGHTS, DensityField, density_field, force_at

STIFFNESS, LIMIT = 500.0, 3000.0
SPACING = (0.5, 0.5, 0.5)


def field_of(rigid: np.ndarray, limit: float = LIMIT, place: Rigid | None = None) -> DensityField:
    return density_field(rigid, SPACING, place or Rigid.identity(), STIFFNESS, limit)


def felt(field: DensityField, tip: Array, direction: Array | None = None) -> Array:
    force = np.empty(3)
    force_at(field.density, field.constants, tip, force, np.zeros(3) if direction is None else direction)
    return force


def plane() -> np.ndarray:
    """Rigid for z < 16 voxels: the wall is half-way between the centres of voxels 15 and 16."""
    rigid = np.zeros((32, 32, 32), dtype=bool)
    rigid[:, :, :16] = True
    return rigid


def ball(radius: float, n: int = 48) -> np.ndarray:
    at = np.indices((n, n, n)) - (n - 1) / 2
    return np.asarray((at**2).sum(axis=0) < radius**2)


def test_the_filter_is_a_normal_distribution_cut_at_two_and_scaled_to_one() -> None:
    assert len(WEIGHTS) == 5
    assert WEIGHTS.sum() == pytest.approx(1.0, abs=1e-15)
    assert WEIGHTS[1] / WEIGHTS[2] == pytest.approx(math.exp(-0.5), rel=1e-14)
    assert WEIGHTS[0] / WEIGHTS[2] == pytest.approx(math.exp(-2.0), rel=1e-14)


@given(st.floats(11.0, 20.0))
def test_a_plane_pushes_as_the_formula_says(w: float) -> None:
    """f = k d along +z, where d is linear between the sums of the weights that reach into the wall.

    Densities are single precision: five products and sums of numbers below 1 are off by less than 1e-6, the force by
    that part of k · depth = 500 · 0.5 / 0.4026 mN.
    """
    field = field_of(plane())
    density = [sum(WEIGHTS[r + REACH] for r in range(-REACH, REACH + 1) if k + r < 16) for k in range(32)]
    d = float(np.interp(w, np.arange(32), density))
    direction = np.array([0.0, 0.0, 1.0])  # below two voxels and a half from the wall the gradient is zero
    force = felt(field, np.array([8.0, 8.0, 0.5 * w]), direction)
    full = STIFFNESS * 0.5 / WEIGHTS[REACH]
    np.testing.assert_allclose(force, [0.0, 0.0, full * d], atol=1e-6 * full)


def test_the_stiffness_is_the_steepest_growth_at_a_wall() -> None:
    """Between the centres beside the wall the force is linear in depth; two single precision densities give 1e-6."""
    field = field_of(plane())
    a, b = felt(field, np.array([8.0, 8.0, 7.6])), felt(field, np.array([8.0, 8.0, 7.9]))
    assert (a - b)[2] / 0.3 == pytest.approx(STIFFNESS, rel=1e-5)


def test_a_sphere_pushes_outwards_as_the_formula_says() -> None:
    """The direction is radial and the size k times the density, which is that of a plane at the same depth.

    Ball of R = 15 voxels, tip within one voxel of its surface. Direction: a centre is in or out by up to half a voxel's
    diagonal (0.87) wrongly against the smooth ball; the filter averages over some (2π)^(3/2) = 16 voxels of which
    those at the surface, about 6, are wrong with a spread of 1/√12 each: the smoothed surface is rough by 0.29/√6 =
    0.12 voxels over a length of about 2 voxels (the differences' base): a slope of 0.06 rad, of which three times is
    allowed for the worst of 400. Density: the same roughness times the slope 0.4, three times: 0.14; the curvature
    (1/R of the plane's, σ²/R = 0.07 voxels) adds 0.03.
    """
    radius = 15.0
    field = field_of(ball(radius))
    random = np.random.default_rng(5)
    full = STIFFNESS * 0.5 / WEIGHTS[REACH]
    for _ in range(400):
        out = random.normal(size=3)
        out /= np.linalg.norm(out)
        depth = random.uniform(-1.0, 1.0)  # voxels, positive inside
        force = felt(field, 0.5 * (23.5 + (radius - depth) * out))
        d = 0.5 * (1.0 + math.erf(depth / math.sqrt(2.0)))
        assert math.acos(min(1.0, float(force @ out) / float(np.linalg.norm(force)))) < 0.18
        assert abs(np.linalg.norm(force) / full - d) < 0.17


@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_the_force_is_continuous(numbers: list[float]) -> None:
    """Two tips at a distance h near the surface of a ball feel forces that differ by less than L h.

    d is trilinear between densities that differ by at most w0 = 0.41 from voxel to voxel: |∇d| <= √3 · 0.41 per voxel.
    The direction g/|g| turns by at most 2 |Δg| / |g|; each component of g is a difference of two such d, so |Δg| <=
    √3 · 2 · √3 · 0.41 h, and |g| >= 0.2 within a voxel of the surface (asserted). With the density at most 1: L =
    full · (0.71 + 2 · 2.46 / 0.2) per voxel. A jump at a voxel's face would show at any h.
    """
    field = field_of(ball(15.0))
    out = np.add(numbers[:3], [2.0, 0.0, 0.0])
    out /= np.linalg.norm(out)
    tip = 23.5 + (15.0 + numbers[3]) * out
    h = 1e-6
    full = STIFFNESS * 0.5 / WEIGHTS[REACH]
    for axis in np.eye(3):
        jump = np.linalg.norm(felt(field, 0.5 * (tip + h * axis)) - felt(field, 0.5 * tip))
        assert jump <= full * (0.71 + 2.0 * 2.46 / 0.2) * h + 1e-9


def test_outside_and_at_the_rim_there_is_no_force_and_no_jump() -> None:
    """The wall reaches the grid's side; beyond it the density falls to zero within the filter's reach."""
    field = field_of(plane())
    for tip in ([-2.6, 8.0, 4.0], [8.0, 99.0, 4.0], [1e300, 0.0, 0.0], [math.nan, 8.0, 4.0], [math.inf, 8.0, 4.0]):
        assert felt(field, np.array(tip)).tolist() == [0.0, 0.0, 0.0]
    x = np.linspace(-3.0, 1.0, 4001)
    force = np.array([felt(field, np.array([a, 8.0, 4.0]), np.array([-1.0, 0.0, 0.0])) for a in x])
    full = STIFFNESS * 0.5 / WEIGHTS[REACH]
    # 1 µm apart: the density changes by 0.41 per voxel of 0.5 mm, with a little for single precision.
    assert np.abs(np.diff(np.linalg.norm(force, axis=1))).max() <= full * 0.41 * 0.002 + 1e-3
    assert np.linalg.norm(force[-1]) == pytest.approx(full, rel=1e-6)


def test_deep_inside_the_last_direction_holds() -> None:
    """Where all samples are alike the gradient is exactly zero; a tip that comes from nowhere feels nothing."""
    field = field_of(plane())
    deep = np.array([8.013, 8.02, 3.37])
    assert felt(field, deep).tolist() == [0.0, 0.0, 0.0]
    direction = np.zeros(3)
    full = STIFFNESS * 0.5 / WEIGHTS[REACH]
    for z in np.linspace(8.5, 3.37, 50):
        force = felt(field, np.array([8.013, 8.02, z]), direction)
    np.testing.assert_allclose(force, [0.0, 0.0, full], rtol=1e-6, atol=1e-6 * full)


def test_no_force_is_longer_than_the_device_can_make() -> None:
    field = field_of(plane(), limit=200.0)
    sizes = [np.linalg.norm(felt(field, np.array([8.0, 8.0, z]), np.array([0.0, 0.0, 1.0]))) for z in (8.8, 7.0, 4.0)]
    assert sizes[0] < 200.0 - 1e-9
    assert sizes[1:] == pytest.approx([200.0, 200.0], rel=1e-12)


@given(st.floats(-3.0, 3.0), st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
def test_the_field_moves_with_its_volume(angle: float, offset: list[float]) -> None:
    """Turned and moved, the same tip feels the turned force; rotations and sums round at 1e-13 of 40 mm."""
    place = Rigid(10.0 * np.array(offset), quaternion_from_axis_angle([1.0, 2.0, -0.5], angle))
    there, here = field_of(ball(10.0, 32), place=place), field_of(ball(10.0, 32))
    tip = np.array([3.1, 6.0, 7.2])
    np.testing.assert_allclose(felt(there, place.apply(tip)), place.rotate(felt(here, tip)), atol=1e-7)


def test_voxels_that_are_no_cubes_push_normal_to_the_wall() -> None:
    """A wall at 45° in mm through voxels of 0.3 × 0.3 × 0.9 mm, stairs smoothed: mean direction within 0.05.

    Without dividing by the spacing the directions would point 18° off: atan(3) - 45° is 26°, less what smoothing takes.
    """
    at = np.indices((60, 8, 20)).transpose(1, 2, 3, 0) * [0.3, 0.3, 0.9]
    field = density_field(np.asarray(at[..., 0] + at[..., 2] < 17.5), (0.3, 0.3, 0.9), Rigid.identity(), 500.0, 3000.0)
    directions = []
    for x in np.linspace(6.0, 12.0, 41):
        direction = np.zeros(3)
        felt(field, np.array([x, 1.2, 17.5 - x]), direction)
        directions.append(direction)
    np.testing.assert_allclose(np.mean(directions, axis=0), [math.sqrt(0.5), 0.0, math.sqrt(0.5)], atol=0.05)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_impossible_numbers_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="stiffness must be positive"):
        density_field(plane(), SPACING, Rigid.identity(), bad, LIMIT)
    with pytest.raises(ValueError, match="limit must be positive"):
        density_field(plane(), SPACING, Rigid.identity(), STIFFNESS, bad)
