"""Normals of the vertices of a triangulated surface."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array


@njit(cache=True, nogil=True, error_model="numpy")
def vertex_normals(vertices: Array, triangles: np.ndarray, normals: Array) -> None:
    """Unit normals (v, 3) of ``vertices`` (v, 3): the mean of the triangles' normals weighted by their area.

    A vertex without area around it gets the zero vector.
    """
    for i in range(len(vertices)):
        normals[i, 0] = normals[i, 1] = normals[i, 2] = 0.0
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ux = vertices[b, 0] - vertices[a, 0]
        uy = vertices[b, 1] - vertices[a, 1]
        uz = vertices[b, 2] - vertices[a, 2]
        vx = vertices[c, 0] - vertices[a, 0]
        vy = vertices[c, 1] - vertices[a, 1]
        vz = vertices[c, 2] - vertices[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for i in (a, b, c):
            normals[i, 0] += nx
            normals[i, 1] += ny
            normals[i, 2] += nz
    for i in range(len(vertices)):
        length = math.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2)
        if length > 0.0:
            normals[i, 0] /= length
            normals[i, 1] /= length
            normals[i, 2] /= length
