"""Distances and contacts of rigid bodies: parts of instruments, bone, a trocar. By python-fcl.

A body is made once, in its own frame, and placed as often as it moves; a mesh gets its tree of boxes then (Pan, Chitta
and Manocha 2012, "FCL: A general purpose library for collision and proximity queries"). What deforms is searched by
:mod:`trainer.mechanics.cells`: to FCL it would be a new body every tick.

FCL answers some questions in a way of its own, which is put right here and told in the tests: for a mesh and another
shape it puts the mesh first, whatever was asked; the nearest points of a mesh and a sphere are each in its body's own
frame; depths between a mesh and a sphere are negative; the distance of bodies that touch is -1 or whatever was in the
memory before, so that is asked first. The distance of a box and a mesh was too large by up to 2 % in a quarter of
random places: there the box's own surface is taken as a mesh.

A mesh is a surface: a body that lies wholly inside a closed mesh does not touch it.
"""

from __future__ import annotations

from dataclasses import dataclass

import fcl
import numpy as np

from trainer.geometry import Array, Rigid
from trainer.mechanics.pair_list import checked_elements, largest_magnitude

#: The triangles of a box whose corners are numbered by the bits x, y, z.
BOX = np.array(
    [
        (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
    ],
    dtype=np.int32,
)  # fmt: skip


@dataclass(frozen=True)
class Nearest:
    """How far two bodies are apart, and where they are nearest, in the world frame."""

    distance_mm: float  # 0 when they touch
    on_first: Array | None  # (3,) mm; None when they touch: then there is no single pair of nearest points
    on_second: Array | None  # (3,) mm


@dataclass(frozen=True)
class Contacts:
    """Where two bodies touch, in the world frame; no rows when they do not."""

    points: Array  # (k, 3) mm
    normals: Array | None  # (k, 3) unit vectors from the first body to the second; None between two meshes, where
    depths_mm: Array | None  # (k,) FCL reports planes and depths of whole triangles


class RigidBody:
    """A shape with a place. Made by ``sphere``, ``box``, ``capsule``, ``cylinder`` or ``mesh``, in the body's frame."""

    def __init__(self, shape: fcl.CollisionGeometry) -> None:
        self.is_mesh = isinstance(shape, fcl.BVHModel)
        self.is_sphere = isinstance(shape, fcl.Sphere)
        self.placed = fcl.CollisionObject(shape, fcl.Transform())
        self.surface = self.placed  # what distances to a mesh are taken of
        self.world_from_body = Rigid.identity()

    @classmethod
    def sphere(cls, radius_mm: float) -> RigidBody:
        """A sphere about the origin."""
        return cls(fcl.Sphere(_length(radius_mm, "radius_mm")))

    @classmethod
    def box(cls, sides_mm: tuple[float, float, float]) -> RigidBody:
        """A box about the origin with these sides along x, y, z."""
        sides = [_length(side, "sides_mm") for side in sides_mm]
        body = cls(fcl.Box(*sides))
        corners = np.array((np.indices((2, 2, 2)).reshape(3, 8).T - 0.5) * sides, dtype=np.float64, order="C")
        body.surface = fcl.CollisionObject(_surface(corners, BOX), fcl.Transform())
        return body

    @classmethod
    def capsule(cls, radius_mm: float, length_mm: float) -> RigidBody:
        """All places within the radius of a line of this length, along z about the origin."""
        return cls(fcl.Capsule(_length(radius_mm, "radius_mm"), _length(length_mm, "length_mm")))

    @classmethod
    def cylinder(cls, radius_mm: float, length_mm: float) -> RigidBody:
        """A cylinder along z about the origin."""
        return cls(fcl.Cylinder(_length(radius_mm, "radius_mm"), _length(length_mm, "length_mm")))

    @classmethod
    def mesh(cls, vertices: Array, triangles: np.ndarray) -> RigidBody:
        """The surface of ``triangles`` (f, 3) over ``vertices`` (v, 3) mm. Raises ValueError for bad or none."""
        largest_magnitude(vertices, "vertices")
        corners = checked_elements(triangles, 3, "triangles")
        if not len(corners) or corners.max() >= len(vertices):
            raise ValueError(f"triangles: expected at least one, over {len(vertices)} vertices")
        return cls(_surface(vertices, corners))

    def place(self, world_from_body: Rigid) -> None:
        """Put the body there. Raises ValueError for a pose that is not finite."""
        if not (np.isfinite(world_from_body.position).all() and np.isfinite(world_from_body.quaternion).all()):
            raise ValueError(f"a rigid body was placed at {world_from_body.position.tolist()}: poses must be finite")
        self.world_from_body = world_from_body
        transform = fcl.Transform(world_from_body.quaternion, world_from_body.position)
        self.placed.setTransform(transform)
        self.surface.setTransform(transform)


def nearest(first: RigidBody, second: RigidBody) -> Nearest:
    """The distance of two bodies where they are placed.

    Exact to rounding between spheres, boxes and meshes. Where a capsule or a cylinder takes part FCL iterates (Gilbert,
    Johnson and Keerthi 1988): errors up to 6e-6 mm were met at 1 mm, and the points shift by 1e-3 mm along directions
    in which the distance hardly changes.
    """
    if fcl.collide(first.placed, second.placed):
        return Nearest(0.0, None, None)
    result = fcl.DistanceResult()
    meshes = first.is_mesh or second.is_mesh
    one, other = (first.surface, second.surface) if meshes else (first.placed, second.placed)
    distance = fcl.distance(one, other, fcl.DistanceRequest(enable_nearest_points=True), result)
    on_first, on_second = (np.array(point) for point in result.nearest_points)
    if _swapped(first, second) and first.surface is first.placed:
        on_first, on_second = on_second, on_first
    if (first.is_mesh and second.is_sphere) or (second.is_mesh and first.is_sphere):
        on_first, on_second = first.world_from_body.apply(on_first), second.world_from_body.apply(on_second)
    return Nearest(float(distance), on_first, on_second)


def contacts(first: RigidBody, second: RigidBody, most: int = 16) -> Contacts:
    """Up to ``most`` places where two bodies touch. A depth is how far they overlap along the normal there."""
    result = fcl.CollisionResult()
    fcl.collide(first.placed, second.placed, fcl.CollisionRequest(num_max_contacts=most, enable_contact=True), result)
    points = np.array([c.pos for c in result.contacts]).reshape(-1, 3)
    if first.is_mesh and second.is_mesh:
        return Contacts(points, None, None)
    normals = np.array([c.normal for c in result.contacts]).reshape(-1, 3)
    depths = np.abs([c.penetration_depth for c in result.contacts])
    return Contacts(points, -normals if _swapped(first, second) else normals, np.asarray(depths, dtype=np.float64))


def _swapped(first: RigidBody, second: RigidBody) -> bool:
    return second.is_mesh and not first.is_mesh


def _surface(vertices: Array, triangles: np.ndarray) -> fcl.BVHModel:
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(triangles))
    model.addSubModel(vertices, triangles)
    model.endModel()
    return model


def _length(length: float, name: str) -> float:
    if not (length > 0.0 and np.isfinite(length)):
        raise ValueError(f"{name} must be larger than 0 mm, found {length}")
    return length
