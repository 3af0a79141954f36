"""Verification of pictures on a ball and a slab, where every pixel is known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainer.geometry import Array
from trainer.pictures.camera import Camera
from trainer.pictures.pictures import Plane, section, see_through, surface
from trainer.pictures.solid import BRICK, Solid, look_of, solid_of

RED, BLUE = (200, 40, 20), (20, 40, 200)
LOOK = look_of({1: (RED, 0.05), 2: (BLUE, 0.05)})
SPACING = (0.5, 0.5, 1.0)
MIDDLE = np.array([15.75, 15.75, 15.5])


def ball(radius: float = 10.0) -> Solid:
    """Label 1 within ``radius`` mm of the grid's middle."""
    at = np.indices((64, 64, 32)).transpose(1, 2, 3, 0) * SPACING - MIDDLE
    return solid_of((np.linalg.norm(at, axis=-1) < radius).astype(np.uint8), SPACING, LOOK)


def camera(eye: Array, width: int = 90, height: int = 70) -> Camera:
    return Camera(eye, MIDDLE, np.array([0.0, 0.0, 1.0]), 40.0, width, height)


def sphere_depth(view: Camera, radius: float) -> Array:
    """(h, w) mm along each pixel's ray to a sphere about the middle; infinite where it is missed."""
    eye, corner, right, down = view.rays()
    row, column = np.mgrid[0 : view.height, 0 : view.width] + 0.5
    d = corner + column[..., None] * right + row[..., None] * down
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ (eye - MIDDLE)
    root = b**2 - (eye - MIDDLE) @ (eye - MIDDLE) + radius**2
    return np.where(root > 0.0, -b - np.sqrt(np.maximum(root, 0.0)), np.inf)


@pytest.mark.parametrize("eye", [(60.0, 15.0, 15.5), (15.75, -40.0, 30.0), (40.0, 50.0, -20.0), (15.75, 15.8, 60.0)])
def test_a_ball_is_seen_where_it_is(eye: tuple[float, float, float]) -> None:
    """Depth as of a sphere, within the spread of the smoothed voxels' surface.

    Voxels of 0.5 × 0.5 × 1 mm: the smoothed surface lies within half a voxel's diagonal (0.61 mm) of the sphere; seen
    at 60° at most off the normal (the middle of the disc: 0.85 R) that is 1.2 mm along the ray. Rays that miss the
    sphere by more than 0.61 mm see nothing.
    """
    view = camera(np.array(eye))
    picture, depth = surface(ball(), view)
    inner, outer = sphere_depth(view, 8.5), sphere_depth(view, 10.61)
    hit = np.isfinite(inner)
    assert np.abs(depth[hit] - sphere_depth(view, 10.0)[hit]).max() < 1.2
    assert np.isinf(depth[np.isinf(outer)]).all()
    assert np.isinf(outer).any()
    assert picture[hit].any(axis=1).all()
    assert not picture[np.isinf(depth)].any()


def test_light_comes_from_the_eye() -> None:
    """Lambert: at an angle a to the normal a surface sends back 1/4 + 3/4 cos a of its colour (marching.AMBIENT).

    Normals of the smoothed ball are off by up to 0.2 rad (see the density field's test): 0.75 · 0.2 of the colour, and
    one level for whole numbers; over all pixels the mean is off by a fifth of that.
    """
    view = camera(np.array([60.0, 15.75, 15.5]))
    picture, _ = surface(ball(), view)
    eye, corner, right, down = view.rays()
    row, column = np.mgrid[0 : view.height, 0 : view.width] + 0.5
    d = corner + column[..., None] * right + row[..., None] * down
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    depth = sphere_depth(view, 10.0)
    hit = np.isfinite(sphere_depth(view, 8.5))
    with np.errstate(invalid="ignore"):
        normal = (eye + depth[..., None] * d - MIDDLE) / 10.0
    wanted = 200.0 * (0.25 - 0.75 * np.sum(normal * d, axis=-1))[hit]
    assert np.abs(picture[..., 0][hit] - wanted).max() < 200.0 * 0.15 + 1.0
    assert abs(np.mean(picture[..., 0][hit] - wanted)) < 200.0 * 0.03 + 1.0


def test_a_slab_lets_through_what_its_opacity_leaves() -> None:
    """A slab of 8 mm across the view, 0.05 per mm, takes 1 - exp(-0.4) of the light: Beer's law.

    Deep inside a place sends back 1/4 + 3/4 · 1/2 of its colour; in the smoothed faces, 2 · 2 voxels of 16, it is more,
    at most all. So the brightness lies between that of all inside and that of all lit.
    """
    labels = np.zeros((32, 32, 64), dtype=np.uint8)
    labels[:, :, 24:40] = 1
    solid = solid_of(labels, (0.5, 0.5, 0.5), LOOK)
    middle = np.array([7.75, 7.75, 15.75])
    view = Camera(middle - [0.0, 0.0, 300.0], middle, np.array([0.0, 1.0, 0.0]), 0.5, 8, 8)
    got = float(see_through(solid, view)[4, 4, 0])
    taken = 200.0 * (1.0 - math.exp(-0.05 * 8.0))
    assert (0.25 + 0.375) * taken - 2.0 <= got <= taken


def test_what_is_not_shown_hides_nothing() -> None:
    """A blue ball behind a slab that is left out is seen as if alone."""
    at = np.indices((48, 48, 48)).transpose(1, 2, 3, 0) - 23.5
    labels = (2 * (np.linalg.norm(at - [0, 0, 10], axis=-1) < 8.0)).astype(np.uint8)
    covered = labels.copy()
    covered[:, :, 5:8] = 7
    view = Camera(np.array([23.5, 23.5, -60.0]), np.array([23.5, 23.5, 23.5]), np.array([0.0, 1.0, 0.0]), 40.0, 50, 40)
    alone, behind = (surface(solid_of(v, (1.0, 1.0, 1.0), LOOK), view) for v in (labels, covered))
    np.testing.assert_array_equal(alone[0], behind[0])
    np.testing.assert_array_equal(alone[1], behind[1])
    assert np.isfinite(alone[1]).any()


def test_skipping_empty_bricks_changes_nothing() -> None:
    """The same pictures with every brick marked: leaving a brick in one step only leaves out samples of nothing.

    Samples beyond a brick lie elsewhere then: a surface is found by bisection to 1/32 step, a see-through picture may
    differ by the light of one step at its ends, 0.05 · 0.6 mm of 200.
    """
    solid = ball()
    dense = Solid(solid.labels, solid.density, np.ones_like(solid.bricks), solid.spacing_mm, solid.look)
    assert (solid.bricks == 0).any()
    view = camera(np.array([40.0, 50.0, -20.0]))
    (_, a), (_, b) = surface(solid, view), surface(dense, view)
    both = np.isfinite(a) & np.isfinite(b)
    assert np.count_nonzero(np.isfinite(a) != np.isfinite(b)) <= 0.01 * a.size
    assert np.median(np.abs(a[both] - b[both])) < 0.05
    assert np.abs(see_through(solid, view).astype(int) - see_through(dense, view)).max() <= 8


def test_bricks_are_empty_only_where_no_sample_sees_anything() -> None:
    solid = ball()
    for a, b, c in np.argwhere(solid.bricks == 0).tolist():
        part = solid.density[
            max(a * BRICK - 1, 0) : (a + 1) * BRICK + 1,
            max(b * BRICK - 1, 0) : (b + 1) * BRICK + 1,
            max(c * BRICK - 1, 0) : (c + 1) * BRICK + 1,
        ]
        assert not part.any()


def test_an_eye_inside_sees_the_surface_at_once_and_one_that_looks_away_nothing() -> None:
    view = camera(np.add(MIDDLE, [3.0, 0.0, 0.0]), 10, 10)
    picture, depth = surface(ball(), view)
    assert np.all(depth < 0.5)
    assert picture.any()
    away = Camera(np.array([60.0, 15.0, 15.0]), np.array([90.0, 15.0, 15.0]), np.array([0.0, 0.0, 1.0]), 40.0, 10, 10)
    picture, depth = surface(ball(), away)
    assert np.isinf(depth).all()
    assert not picture.any()
    assert not see_through(ball(), away).any()


def test_a_section_shows_the_voxel_in_which_each_pixel_lies() -> None:
    """An oblique plane through the ball: a disc of its radius; each pixel compared with the voxel at its place."""
    solid = ball()
    right, down = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0), np.array([1.0, -1.0, -1.0]) / math.sqrt(3.0)
    picture = section(solid, Plane(MIDDLE, right, down, 0.4, 101, 81))
    row, column = np.mgrid[0:81, 0:101]
    place = MIDDLE + 0.4 * ((column - 50)[..., None] * right + (row - 40)[..., None] * down)
    index = np.floor(place / SPACING + 0.5).astype(int)
    inside = np.all((index >= 0) & (index < solid.labels.shape), axis=-1)
    for r, c in np.argwhere(inside)[::37]:
        assert tuple(picture[r, c]) == (RED if solid.labels[tuple(index[r, c])] else (0, 0, 0))
    assert not picture[~inside].any()
    # Area of the disc: a pixel or voxel at its edge (2πR / 0.4 = 157) is in or out wrongly by half at most.
    assert 0.16 * picture.any(axis=-1).sum() == pytest.approx(math.pi * 100.0, abs=0.5 * 157 * 0.61)


def test_pictures_are_the_same_from_run_to_run() -> None:
    view = camera(np.array([40.0, 50.0, -20.0]))
    np.testing.assert_array_equal(see_through(ball(), view), see_through(ball(), view))


def test_impossible_views_and_volumes_are_refused() -> None:
    with pytest.raises(ValueError, match="zero length"):
        surface(ball(), Camera(MIDDLE - [0.0, 0.0, 50.0], MIDDLE, np.array([0.0, 0.0, 1.0]), 40.0, 10, 10))
    with pytest.raises(ValueError, match="at least two voxels"):
        solid_of(np.zeros((1, 4, 4), dtype=np.uint8), SPACING, LOOK)
