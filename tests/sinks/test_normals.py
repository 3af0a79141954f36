"""Normals of a surface against closed forms."""

from __future__ import annotations

import numpy as np
import trimesh

from trainer.sinks.normals import vertex_normals

#: A few dozen operations on numbers near 1: 2^-52 · 100.
ROUNDING = 1e-13


def test_a_regular_polyhedrons_normals_point_along_its_vertices() -> None:
    """By symmetry the triangles around a vertex of an icosahedron sum to a vector along its radius."""
    solid = trimesh.creation.icosahedron()
    vertices = np.ascontiguousarray(solid.vertices, dtype=np.float64)
    normals = np.zeros_like(vertices)
    vertex_normals(vertices, np.ascontiguousarray(solid.faces, dtype=np.int32), normals)
    radii = np.linalg.norm(vertices, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, vertices / radii, atol=ROUNDING)


def test_large_triangles_weigh_more() -> None:
    """Two triangles at a right angle share an edge; areas 1 and 3 give a normal along (1, 0, 3)."""
    vertices = np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3]], dtype=np.int32)
    normals = np.ones_like(vertices)
    vertex_normals(vertices, triangles, normals)
    np.testing.assert_allclose(normals[0], np.array([1.0, 0.0, 3.0]) / np.sqrt(10.0), atol=ROUNDING)


def test_a_vertex_without_area_has_no_normal() -> None:
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [9.0, 9.0, 9.0]])
    normals = np.ones_like(vertices)
    vertex_normals(vertices, np.array([[0, 1, 2]], dtype=np.int32), normals)
    np.testing.assert_array_equal(normals, np.zeros_like(vertices))
