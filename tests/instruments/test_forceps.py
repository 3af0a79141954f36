"""The laws of the forceps' geometry."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from trainer.geometry import Rigid, quaternion_from_euler_deg
from trainer.instruments import forceps

#: Rounding of a few operations on lengths of up to 100 mm: 100 · 2^-52 · ~10, well below an atom.
ROUNDING_MM = 1e-12


def tip_inner_points(world_from_tool: Rigid, closure: float) -> np.ndarray:
    """Midpoint of each blade's inner edge at its tip, (2, 3) in the world."""
    positions, quaternions = forceps.part_poses(world_from_tool, closure)
    tip = np.array([forceps.BLADE_MM, 0.0, 0.0])
    return np.stack([Rigid(p, q).apply(tip) for p, q in zip(positions, quaternions, strict=True)])


@pytest.mark.parametrize("side", [0, 1])
def test_a_blade_is_closed_and_its_normals_point_outwards(side: int) -> None:
    blade = forceps.parts()[side]
    mesh = trimesh.Trimesh(blade.vertices, blade.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0.0  # divergence theorem: positive only with outward normals
    assert mesh.body_count == 1
    assert blade.triangles.dtype == np.int32


def test_the_blades_are_mirror_images_and_lie_on_their_own_sides() -> None:
    upper, lower = forceps.parts()
    np.testing.assert_array_equal(upper.vertices * [1, -1, 1], lower.vertices)
    assert upper.vertices[:, 1].min() == 0.0
    assert lower.vertices[:, 1].max() == 0.0


def test_the_tips_are_as_slender_as_stated() -> None:
    upper = forceps.parts()[0].vertices
    tip = upper[upper[:, 0] == forceps.BLADE_MM]
    extent = np.ptp(tip, axis=0)
    assert extent[2] == pytest.approx(forceps.TIP_WIDTH_MM, abs=ROUNDING_MM)
    # The arc of an even number of points has none at its crown: cos(π/22) = 0.9898 of the thickness.
    assert 0.98 * forceps.TIP_THICKNESS_MM < extent[1] <= forceps.TIP_THICKNESS_MM


@pytest.mark.parametrize("rotation", [(0, 0, 0), (0, 60, 130), (-75, 20, 5)])
def test_closed_tips_meet_at_the_instruments_origin(rotation: tuple[float, float, float]) -> None:
    pose = Rigid(np.array([3.0, -3.0, 4.0]), quaternion_from_euler_deg(rotation))
    np.testing.assert_allclose(tip_inner_points(pose, 1.0), np.stack([pose.position] * 2), atol=ROUNDING_MM)


@pytest.mark.parametrize("closure", [0.0, 0.25, 0.5, 0.9, 1.0])
def test_the_gap_is_the_distance_of_the_tips_along_the_opening_direction(closure: float) -> None:
    pose = Rigid(np.array([3.0, -3.0, 4.0]), quaternion_from_euler_deg((10, 60, 130)))
    upper, lower = pose.inverse().apply(tip_inner_points(pose, closure))
    assert upper[1] - lower[1] == pytest.approx(forceps.jaw_gap_mm(closure), abs=ROUNDING_MM)
    assert upper[1] == pytest.approx(-lower[1], abs=ROUNDING_MM)
    assert upper[2] == pytest.approx(0.0, abs=ROUNDING_MM)


def test_the_gap_shrinks_from_open_to_closed_and_stays_within_its_ends() -> None:
    assert forceps.jaw_gap_mm(0.0) == pytest.approx(forceps.OPEN_GAP_MM, abs=ROUNDING_MM)
    assert forceps.jaw_gap_mm(1.0) == 0.0
    gaps = [forceps.jaw_gap_mm(c) for c in np.linspace(0.0, 1.0, 11)]
    assert all(a > b for a, b in itertools.pairwise(gaps))
    assert forceps.jaw_gap_mm(-0.1) == forceps.jaw_gap_mm(0.0)
    assert forceps.jaw_gap_mm(1.1) == 0.0
