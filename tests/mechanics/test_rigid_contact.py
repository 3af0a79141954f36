"""Distances and contacts of rigid bodies against closed forms, in any place and either order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.geometry import Rigid, unit
from trainer.mechanics.rigid_contact import RigidBody, contacts, nearest

# A tetrahedron at the origin with legs of 1 mm; normals outwards.
VERTICES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
#: FCL's iterations end at 1e-6 of what they measure, which is no bound: 6e-6 mm were met in 16 000 places.
ITERATED = 2e-5


def pose(seed: int) -> Rigid:
    rng = np.random.default_rng(seed)
    return Rigid(rng.uniform(-5.0, 5.0, 3), unit(rng.normal(size=4)))


def at(*place: float) -> Rigid:
    return Rigid(np.array(place), np.array([1.0, 0.0, 0.0, 0.0]))


seeds = st.integers(0, 10**6)


@given(seeds, seeds)
def test_spheres_are_as_far_apart_as_their_middles_less_the_radii(one: int, other: int) -> None:
    """Rounded: a few 1e-15 of up to 20 mm."""
    a, b = pose(one), pose(other)
    first, second = RigidBody.sphere(0.5), RigidBody.sphere(0.25)
    first.place(a)
    second.place(b)
    way = b.position - a.position
    far = float(np.linalg.norm(way))
    found = nearest(first, second)
    assert found.distance_mm == pytest.approx(max(far - 0.75, 0.0), abs=1e-12)
    if far > 0.8:
        assert found.on_first == pytest.approx(a.position + 0.5 * way / far, abs=1e-12)
        assert found.on_second == pytest.approx(b.position - 0.25 * way / far, abs=1e-12)
        assert len(contacts(first, second).points) == 0


@given(seeds, st.sampled_from(("sphere", "capsule", "box", "cylinder", "mesh")))
def test_a_face_of_a_mesh_is_as_far_as_it_was_put_in_any_frame_and_order(seed: int, kind: str) -> None:
    """Every body is put so that its foremost point is 0.7 mm before the face x = 0, above (0.2, 0.2)."""
    body, reach = {
        "sphere": (RigidBody.sphere(0.3), 0.3),
        "capsule": (RigidBody.capsule(0.3, 2.0), 0.3),
        "box": (RigidBody.box((0.6, 0.1, 0.1)), 0.3),
        "cylinder": (RigidBody.cylinder(0.3, 2.0), 0.3),
        "mesh": (RigidBody.mesh(VERTICES - [1.0, 0.0, 0.0], FACES), 0.0),
    }[kind]
    mesh = RigidBody.mesh(VERTICES, FACES)
    world_from_scene = pose(seed)
    mesh.place(world_from_scene)
    body.place(world_from_scene @ at(-0.7 - reach, 0.2, 0.2))
    for first, second, sense in ((mesh, body, 1.0), (body, mesh, -1.0)):
        found = nearest(first, second)
        assert found.distance_mm == pytest.approx(0.7, abs=ITERATED)
        assert found.on_first is not None
        assert found.on_second is not None
        # Along the face the iterations do not care; across it both points are where they must be.
        between = world_from_scene.inverse().rotate(found.on_second - found.on_first)
        assert between == pytest.approx([-0.7 * sense, 0.0, 0.0], abs=2e-3)
        on_mesh = found.on_first if sense > 0.0 else found.on_second
        assert world_from_scene.inverse().apply(on_mesh)[0] == pytest.approx(0.0, abs=ITERATED)


@given(seeds, st.floats(0.1, 3.0))
def test_crossed_capsules_are_as_far_apart_as_their_lines_less_the_radii(seed: int, gap: float) -> None:
    """One along z, one along x, ``gap`` between their surfaces along y."""
    first, second = RigidBody.capsule(0.4, 3.0), RigidBody.capsule(0.2, 2.0)
    world_from_scene = pose(seed)
    first.place(world_from_scene)
    half = np.sqrt(0.5)
    second.place(world_from_scene @ Rigid(np.array([0.3, gap + 0.6, 0.1]), np.array([half, 0.0, half, 0.0])))
    found = nearest(first, second)
    assert found.distance_mm == pytest.approx(gap, abs=ITERATED)


def test_a_boxs_corner_is_the_diagonal_away() -> None:
    """From (1, 1, 1) to (2, 3, 3): 3 mm."""
    first, second = RigidBody.box((2.0, 2.0, 2.0)), RigidBody.box((1.0, 1.0, 1.0))
    second.place(at(2.5, 3.5, 3.5))
    found = nearest(first, second)
    assert found.distance_mm == pytest.approx(3.0, abs=ITERATED)
    assert found.on_first == pytest.approx([1.0, 1.0, 1.0], abs=2e-3)
    assert found.on_second == pytest.approx([2.0, 3.0, 3.0], abs=2e-3)


@given(seeds, st.floats(0.01, 0.3))
def test_a_sphere_in_a_face_overlaps_by_its_depth_along_the_normal(seed: int, depth: float) -> None:
    """A sphere of 0.35 mm pressed into the face x = 0 of a mesh, or of a box; the deepest contact is on the face."""
    world_from_scene = pose(seed)
    mesh, box = RigidBody.mesh(3.0 * VERTICES, FACES), RigidBody.box((2.0, 2.0, 2.0))
    mesh.place(world_from_scene)
    box.place(world_from_scene @ at(1.0, 0.5, 0.5))
    sphere = RigidBody.sphere(0.35)
    sphere.place(world_from_scene @ at(depth - 0.35, 0.6, 0.6))
    for body in (mesh, box):
        for first, second, sense in ((body, sphere, -1.0), (sphere, body, 1.0)):
            found = contacts(first, second)
            assert found.depths_mm is not None
            assert found.normals is not None
            deepest = int(np.argmax(found.depths_mm))
            assert found.depths_mm[deepest] == pytest.approx(depth, abs=1e-9)
            normal = world_from_scene.inverse().rotate(found.normals[deepest])
            assert normal == pytest.approx([sense, 0.0, 0.0], abs=1e-9)
            place = world_from_scene.inverse().apply(found.points[deepest])
            # FCL names a place within the overlap.
            assert 0.0 - 1e-9 <= place[0] <= depth + 1e-9
            assert place[1:] == pytest.approx([0.6, 0.6], abs=1e-9)
            assert nearest(first, second).distance_mm == 0.0
            assert nearest(first, second).on_first is None


def test_two_meshes_tell_where_they_touch_and_no_more() -> None:
    """A corner put 0.1 mm through a face; all places found are within the small corner's box."""
    first, second = RigidBody.mesh(VERTICES, FACES), RigidBody.mesh(VERTICES - [1.0, 0.0, 0.0], FACES)
    second.place(at(0.1, 0.2, 0.2))
    found = contacts(first, second)
    assert len(found.points) > 0
    assert found.normals is None
    assert found.depths_mm is None
    second.place(at(-0.1, 0.2, 0.2))
    assert len(contacts(first, second).points) == 0


def test_a_body_made_once_follows_its_place() -> None:
    first, second = RigidBody.sphere(1.0), RigidBody.mesh(VERTICES, FACES)
    for far in (2.0, 5.0, 3.0):
        first.place(at(-far, 0.2, 0.2))
        assert nearest(first, second).distance_mm == pytest.approx(far - 1.0, abs=1e-12)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="radius_mm"):
        RigidBody.sphere(0.0)
    with pytest.raises(ValueError, match="length_mm"):
        RigidBody.capsule(1.0, float("nan"))
    with pytest.raises(ValueError, match="at least one"):
        RigidBody.mesh(VERTICES, FACES[:0])
    with pytest.raises(ValueError, match="vertices: node 1"):
        RigidBody.mesh(np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, 1.0, 0.0]]), FACES[:1] % 3)
    with pytest.raises(ValueError, match="finite"):
        RigidBody.sphere(1.0).place(at(0.0, np.inf, 0.0))
