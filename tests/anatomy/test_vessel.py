"""Verification of the vessel's geometry, material coordinates and undented normal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from trainer.anatomy.vessel import (
    Vessel,
    build,
    frame,
    material_coordinates,
    node_normals,
    ring,
    ring_normal,
    undented_normal,
    wall_point,
)
from trainer.config import Sourced
from trainer.curriculum import VesselSpec
from trainer.geometry import Array, Rigid, quaternion_from_axis_angle, unit
from trainer.mechanics.attachments import Anchors
from trainer.mechanics.equilibrium import Equilibrium
from trainer.mechanics.links import forces

ASSUMED = Sourced(1000.0, "assumed")
SPEC = VesselSpec("A", (-0.2, 0.1, 0.3), (-1.0, 0.0, 0.0), 1.0, 0.15, 2.0, 21, 24, ASSUMED, ASSUMED, ASSUMED, ASSUMED)
MOVED = Rigid(np.array([1000.0, -300.0, 20.0]), quaternion_from_axis_angle([1.0, 2.0, -0.5], 1.1))


@pytest.fixture(scope="module")
def vessel() -> Vessel:
    return build(SPEC)


def angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.mark.parametrize("axis", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1), (1, 1, 0), (0.3, -0.5, 0.8)])
def test_surfaces_close_and_face_outwards(axis: tuple[float, float, float]) -> None:
    """The display surface is closed; it encloses the prism's volume; each hull's normals leave the vessel's axis.

    Section of the faceted wall: sin(2 pi / m) m (R² - r²) / 2; exact but for rounding.
    """
    v = build(replace(SPEC, axis=axis))
    surface = trimesh.Trimesh(v.mesh.rest, v.display_triangles, process=False)
    m = SPEC.around
    volume = 2.0 * 0.5 * m * np.sin(2 * np.pi / m) * (0.5**2 - 0.35**2)
    assert surface.is_watertight
    assert surface.is_winding_consistent
    assert surface.volume == pytest.approx(volume, rel=1e-12)
    for triangles in (v.outer_triangles, v.inner_triangles):
        corners = v.mesh.rest[triangles] - np.array(SPEC.cut_edge_mm)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outwards = corners.mean(axis=1) - np.outer(corners.mean(axis=1) @ v.axis, v.axis)
        assert np.all(np.sum(normal * outwards, axis=1) > 0.0)
    corners = v.mesh.rest[v.cut_triangles]
    assert np.all(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ v.axis < 0.0)


def test_equal_clock_angles_of_facing_ends_lie_opposite() -> None:
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, -0.64, 0.48)):
        _, twelve, three = frame(unit(axis))
        _, twelve_back, three_back = frame(-unit(axis))
        assert np.allclose(twelve, twelve_back, atol=1e-15)
        assert np.allclose(three, three_back, atol=1e-15)
    _, twelve, three = frame(np.array([-1.0, 0.0, 0.0]))
    assert np.array_equal(twelve, [0.0, 0.0, 1.0])
    assert np.array_equal(three, [0.0, 1.0, 0.0])


def test_rest_is_free_of_force_wherever_the_vessel_stands(vessel: Vessel) -> None:
    """At 1 m a coordinate is rounded to 1e-13 mm; 70 mN/mm and 20 links of it: below 1e-9 mN."""
    assert np.abs(forces(vessel.mesh, vessel.mesh.rest)).max() < 1e-11
    moved = replace(vessel.mesh, rest=MOVED.apply(vessel.mesh.rest))
    assert np.abs(forces(moved, moved.rest)).max() < 1e-9


def test_only_the_clamped_layer_is_fixed(vessel: Vessel) -> None:
    assert np.array_equal(vessel.mesh.fixed, vessel.axial_mm > 1.95)
    assert sorted(vessel.elimination) == list(np.flatnonzero(~vessel.mesh.fixed))


@pytest.mark.parametrize("hull", ["outer", "inner"])
def test_wall_point_and_material_coordinates_are_inverse(vessel: Vessel, hull: str) -> None:
    """Both are linear on a triangle, so they are inverse to rounding; the point lies on a triangle of that hull."""
    triangles = {tuple(sorted(t)) for t in (vessel.outer_triangles if hull == "outer" else vessel.inner_triangles)}
    generator = np.random.default_rng(3)
    for clock, axial in [(0.0, 0.0), (6.28, 0.35), (0.0, 2.0), *generator.uniform((0, 0), (2 * np.pi, 2), (50, 2))]:
        nodes, weights = wall_point(vessel, clock, axial, hull)  # type: ignore[arg-type]
        assert weights.min() > -1e-12
        assert weights.sum() == pytest.approx(1.0, abs=1e-12)
        assert tuple(sorted(nodes)) in triangles
        assert material_coordinates(vessel, nodes, weights) == pytest.approx((axial, clock), abs=1e-12)


def test_material_coordinates_across_twelve_o_clock(vessel: Vessel) -> None:
    nodes, weights = wall_point(vessel, np.radians(359.0), 0.33, "outer")
    for turned in (0, 1, 2):
        axial, clock = material_coordinates(vessel, np.roll(nodes, turned), np.roll(weights, turned))
        assert axial == pytest.approx(0.33, abs=1e-12)
        assert np.degrees(clock) == pytest.approx(359.0, abs=1e-10)


def test_wall_point_outside_is_refused(vessel: Vessel) -> None:
    with pytest.raises(ValueError, match=r"between 0 and 2, found 2\.1"):
        wall_point(vessel, 0.0, 2.1, "outer")


@pytest.mark.parametrize("bite_mm", [0.0, 0.2, 0.35, 0.5, 1.9])
def test_undented_normal_is_radial_at_rest_and_follows_a_rotation(vessel: Vessel, bite_mm: float) -> None:
    """The fit is exact for a rigid motion; at 1 m positions are rounded to 1e-13 mm of 1 mm: 1e-10 rad at most."""
    for clock in np.radians(np.arange(0.0, 360.0, 30.0)):
        radial = np.cos(clock) * vessel.twelve + np.sin(clock) * vessel.three
        assert np.allclose(undented_normal(vessel, vessel.mesh.rest, clock, bite_mm), radial, atol=1e-13)
        moved = MOVED.apply(vessel.mesh.rest)
        assert np.allclose(undented_normal(vessel, moved, clock, bite_mm), MOVED.rotate(radial), atol=1e-10)


@pytest.mark.parametrize(("bite_mm", "most_deg"), [(0.2, 0.4), (0.35, 0.3), (0.5, 0.2), (1.0, 0.2)])
def test_undented_normal_hardly_sees_a_dent_of_one_wall(vessel: Vessel, bite_mm: float, most_deg: float) -> None:
    """A dent as deep as the wall, the lower half of the vessel held still so that it cannot bend as a whole.

    Measured 0.30, 0.22, 0.07 and 0.06 deg; the bounds leave room for another compiler's rounding and nothing else
    of that size. The wall beside the dent itself turns by many degrees, which shows that there is a dent to miss.
    """
    lower = (vessel.clock > np.radians(104.0)) & (vessel.clock < np.radians(256.0))
    mesh = replace(vessel.mesh, fixed=vessel.mesh.fixed | (lower & (np.arange(len(lower)) // SPEC.around % 2 == 0)))
    state = Equilibrium(mesh, (vessel.elimination[~mesh.fixed[vessel.elimination]],))
    slot = state.hold(*wall_point(vessel, 0.0, bite_mm, "outer"))
    target = state.position(slot) - 0.15 * vessel.twelve
    stiffness = 1e4 * np.outer(vessel.twelve, vessel.twelve)
    answer = state.solve(Anchors(np.array([slot]), target[None], stiffness[None]), max_iterations=200)
    assert answer.converged
    assert angle_deg(ring_normal(ring(vessel, 0.0, bite_mm), state.x), vessel.twelve) < most_deg
    layer = round(bite_mm / vessel.layer_mm)
    beside = node_normals(state.x, vessel.outer_triangles)[vessel.node(layer, 1)]
    rest = node_normals(vessel.mesh.rest, vessel.outer_triangles)[vessel.node(layer, 1)]
    assert angle_deg(beside, rest) > 5.0


def test_node_normals_of_a_regular_tube_are_radial(vessel: Vessel) -> None:
    """Away from the ends; a cell's two triangles share a plane, and a node sees both neighbours alike to 1.5 deg."""
    normals = node_normals(vessel.mesh.rest, vessel.outer_triangles)
    for j in range(SPEC.around):
        radial = np.cos(vessel.clock[j]) * vessel.twelve + np.sin(vessel.clock[j]) * vessel.three
        assert angle_deg(normals[vessel.node(10, j)], radial) < 1.5
    assert np.array_equal(normals[vessel.node(10, 0, "inner")], np.zeros(3))
