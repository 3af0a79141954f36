"""Bodies touch where they share a cell; rigid ones are pushed apart as a whole, tissue element by element."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from volume_samples import block, in_cell, material, seeds

from trainer.geometry import Array, Rigid, quaternion_from_axis_angle
from trainer.mechanics.contact_response import Region, push, push_out, region, surface_normals
from trainer.mechanics.occupancy import APART, OccupancyMap, surface_elements
from trainer.mechanics.volume import build, places, start
from trainer.mechanics.volume_drag import drag

ONE = (1.0, 1.0, 1.0)


def grid(n: int) -> np.ndarray:
    return np.argwhere(np.ones((n, n, n), bool))


@given(seeds)
def test_the_pairs_are_those_of_looking_at_all(seed: int) -> None:
    """After any history of moves: bodies that left the map and came back, too."""
    rng = np.random.default_rng(seed)
    bodies = [rng.integers(0, 6, size=(int(rng.integers(1, 40)), 3)) for _ in range(3)]
    where = OccupancyMap((0.0, 0.0, 0.0), (4.0, 5.0, 6.0), 0.7, bodies)
    points = [np.zeros((len(b), 3)) for b in bodies]
    for _ in range(4):
        b = int(rng.integers(0, 3))
        points[b] = rng.uniform(-1.0, 7.0, size=(len(bodies[b]), 3))
        points[b][rng.random(len(points[b])) < 0.05] = np.nan
        where.update(b, points[b])
        entered = [where.cell_of(s) for s in range(len(where.body))]
        for s, cell in enumerate(entered):
            assert cell < 0 or s in in_cell(where, cell)
        index = np.concatenate(bodies)
        truth = [
            (s, t)
            for s in range(len(entered))
            for t in range(s + 1, len(entered))
            if entered[s] == entered[t] >= 0
            and (where.body[s] != where.body[t] or np.abs(index[s] - index[t]).max() > APART)
        ]
        assert [(int(a), int(c)) for a, c in where.touching()] == truth


def test_only_what_goes_to_another_cell_is_entered_anew() -> None:
    where = OccupancyMap((0.0, 0.0, 0.0), (9.0, 9.0, 9.0), 1.0, [grid(3)])
    points = grid(3) + 0.5
    assert where.update(0, points) == 27
    assert where.update(0, points + 0.4) == 0
    assert where.update(0, points + np.array([1.0, 0.0, 0.0])) == 27
    assert where.update(0, points + 100.0) == 27
    assert all(where.cell_of(s) == -1 for s in range(27))


def test_a_sheet_folded_onto_itself_touches_itself() -> None:
    """A strip of 20 bent to a U: its ends share cells, neighbours along it never count."""
    index = np.stack([np.arange(20), np.zeros(20), np.zeros(20)], axis=1)
    where = OccupancyMap((-1.0,) * 3, (12.0,) * 3, 1.0, [index])
    flat = index.astype(float) * 0.5
    where.update(0, flat)
    assert not len(where.touching())
    u = flat.copy()
    u[10:, 0] = 9.5 - u[10:, 0]
    where.update(0, u)
    pairs = where.touching()
    assert len(pairs)
    assert np.all(np.abs(index[pairs[:, 0], 0] - index[pairs[:, 1], 0]) > APART)


def test_a_region_is_the_mean_of_its_contacts() -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0.25], [1.0, 0, 0.75]])
    normals = np.array([[0.0, 0, 1], [0.0, 0, 1], [0.0, 0, -1], [0.0, 0, -1]])
    met = region(points, normals, np.array([[0, 2], [1, 3]]), 1.0)
    assert met is not None
    np.testing.assert_allclose(met.point, (0.5, 0.0, 0.25))
    np.testing.assert_allclose(met.normal, (0.0, 0.0, 1.0))
    assert met.overlap_mm == pytest.approx(0.5 * (0.75 + 0.25))
    assert region(points, normals, np.zeros((0, 2), int), 1.0) is None
    assert region(points[[0, 0]], normals[[0, 0]], np.array([[0, 1]]), 1.0) is None  # no direction says where to


def test_a_push_moves_the_contact_point_by_the_overlap_with_the_least_motion() -> None:
    """First order in the motion: the point goes by the overlap along the normal; of translation t and rotation r that
    do so, |t|² + ρ² |r|² is least (Lagrange: t = s n, r = s l × n / ρ², s = overlap/(1 + |l × n|²/ρ²))."""
    overlap, rho = 1e-4, 3.0
    met = Region(np.array([2.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), overlap, 1)
    pose = Rigid(np.array([0.3, 0.2, 0.1]), quaternion_from_axis_angle((1, 2, 3), 0.4))
    centre = np.array([0.5, 0.5, 0.5])
    body_point = pose.inverse().apply(met.point)
    after = push(met, pose, centre, rho)
    moved = after.apply(body_point) - met.point
    assert moved[2] == pytest.approx(overlap, rel=1e-3)
    lever = np.cross(met.point - centre, met.normal)
    share = overlap / (1.0 + lever @ lever / rho**2)
    centre_moved = after.apply(pose.inverse().apply(centre)) - centre
    np.testing.assert_allclose(centre_moved, share * met.normal, atol=1e-12)


def separate(
    where: OccupancyMap, still: int, moving: int, points: Array, normals: Array, pose: Rigid, most: int = 64
) -> tuple[Rigid, int]:
    """Push the rigid body ``moving`` away from ``still`` until they share no cell; returns its pose and the rounds.

    ``points`` and ``normals`` (s, 3) are of all entries of the map: in the world, but for the moving body's own, which
    are in its frame. Ends after ``most`` rounds, whatever is left.
    """
    own = slice(int(where.begin[moving]), int(where.begin[moving + 1]))
    body_points, body_normals = points[own], normals[own]
    middle = body_points.mean(axis=0)
    gyration = math.sqrt(float(np.mean(np.sum((body_points - middle) ** 2, axis=1))))
    at, facing = points.copy(), normals.copy()
    for done in range(most):
        at[own] = pose.apply(body_points)
        facing[own] = Rigid(np.zeros(3), pose.quaternion).apply(body_normals)
        where.update(moving, np.ascontiguousarray(at[own]))
        pairs = where.touching()
        bodies = where.body[pairs]
        ahead = (bodies[:, 0] == still) & (bodies[:, 1] == moving)
        back = (bodies[:, 0] == moving) & (bodies[:, 1] == still)
        met = region(at, facing, np.concatenate([pairs[ahead], pairs[back][:, ::-1]]), where.cell_mm)
        if met is None:
            return pose, done
        pose = push(met, pose, pose.apply(middle), gyration)
    return pose, most


def test_two_bones_do_not_stay_in_each_other() -> None:
    """A block set 1.5 lengths deep into another, off its middle: pushed out by separate() until no cell is shared."""
    bones = [block((8, 8, 8), spacing=ONE), block((6, 6, 6), spacing=ONE)]
    states = [start(v) for v in bones]
    outer = [surface_elements(s) for s in states]
    index = [np.stack(np.unravel_index(e, v.shape), axis=1) for e, v in zip(outer, bones, strict=True)]
    normals = np.concatenate([surface_normals(s, e) for s, e in zip(states, outer, strict=True)])
    points = np.concatenate([v.rest(e) for e, v in zip(outer, bones, strict=True)])
    where = OccupancyMap((-20.0,) * 3, (30.0,) * 3, 1.0, index)
    where.update(0, points[: len(outer[0])])
    pose = Rigid(np.array([2.3, 1.1, 5.6]), quaternion_from_axis_angle((0, 0, 1), 0.3))
    after, rounds = separate(where, 0, 1, points, normals, pose)
    assert 0 < rounds < 64
    assert not len(where.touching())
    assert after.position[2] > pose.position[2]
    assert np.linalg.norm(after.position - pose.position) < 4.0  # and not thrown away


def test_tissue_is_pushed_out_of_bone_and_its_neighbours_follow() -> None:
    """A rigid plate one cell too high in a block: each touched element goes up by the overlap; the map is then free."""
    volume = block((6, 6, 6), material(1.5, 0.5, 0.5), ONE)
    state = start(volume)
    soft = surface_elements(state)
    at = volume.rest(soft)
    plate = np.array([[x, y, -0.4] for x in range(1, 5) for y in range(1, 5)], dtype=float)
    index = [np.stack(np.unravel_index(soft, volume.shape), axis=1), np.round(plate).astype(int)]
    where = OccupancyMap((-8.5,) * 3, (20.5,) * 3, 1.0, index)
    where.update(0, at)
    where.update(1, plate)
    pairs = where.touching()
    assert len(pairs) == 16
    points = np.concatenate([at, plate])
    normals = np.concatenate([surface_normals(state, soft), np.tile((0.0, 0.0, 1.0), (16, 1))])
    is_soft = np.arange(len(points)) < len(soft)
    entries, by = push_out(points, normals, pairs, is_soft, where.cell_mm)
    assert len(entries) == 16
    np.testing.assert_allclose(by, np.tile((0.0, 0.0, 0.6), (16, 1)), atol=1e-12)
    drag(volume, state, soft[entries], state.u[:, soft[entries]].T + by)
    where.update(0, places(volume, state, soft))
    assert not len(where.touching())


def test_normals_point_away_from_the_tissue() -> None:
    volume = block((3, 3, 3))
    state = start(volume)
    normals = surface_normals(state, np.array([4, 0, 13]))
    np.testing.assert_allclose(normals, [[-1, 0, 0], np.full(3, -1 / math.sqrt(3)), [0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("low", "high", "cell", "word"),
    [
        ((0, 0, 0), (1, 1, 0), 0.1, "no size"),
        ((0, 0, 0), (1, 1, 1), 0.0, "no size"),
        ((0, 0, 0), (1, 1, math.nan), 0.1, "no size"),
        ((0, 0, 0), (1e4, 1e4, 1e4), 0.1, "larger cells"),
    ],
)
def test_a_map_of_no_size_is_refused(low, high, cell, word) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=word):
        OccupancyMap(low, high, cell, [grid(2)])


def test_a_body_keeps_its_number_of_elements() -> None:
    where = OccupancyMap((0.0,) * 3, (9.0,) * 3, 1.0, [grid(2)])
    with pytest.raises(ValueError, match="8 elements"):
        where.update(0, np.zeros((7, 3)))


def test_where_two_labels_are_not_joined_each_has_a_surface() -> None:
    """A layer of bone, 16 elements, three of tissue, where all but the inner 2 × 2 of the middle one lack a link."""
    labels = np.ones((4, 4, 4), np.uint8)
    labels[0] = 2
    volume = build(labels, ONE, {1: material()}, joined=[])
    assert len(surface_elements(start(volume))) == 16 + 44
