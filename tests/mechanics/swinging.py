"""Meshes in motion that several tests share: a spring, a pair of masses, a distorted block."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trainer.geometry import Array
from trainer.mechanics.dynamics import State, at_rest, lumped_masses
from trainer.mechanics.links import LinkMesh, link_mesh, stiffness_from_modulus

WEIGHTLESS = (0.0, 0.0, 0.0)
MASS, STIFFNESS = 2e-6, 8.0  # kg, mN/mm: ω = 2000 / s
FREQUENCY = 2000.0


def spring() -> LinkMesh:
    """A fixed node and a free one, 10 mm apart along x."""
    rest = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    return link_mesh(rest, np.array([[0, 1]]), np.array([STIFFNESS]), np.array([True, False]))


def dumbbell() -> LinkMesh:
    """The same link between two free nodes."""
    return replace(spring(), fixed=np.zeros(2, dtype=bool))


def stretched(mesh: LinkMesh, by: float) -> State:
    state = at_rest(mesh)
    state.x[-1, 0] += by
    return state


#: The two corners between 000 and 111 on each of the six paths along a cube's edges: Kuhn's six tetrahedra.
DIAGONAL_PATHS = (
    ((1, 0, 0), (1, 1, 0)), ((1, 0, 0), (1, 0, 1)), ((0, 1, 0), (1, 1, 0)),
    ((0, 1, 0), (0, 1, 1)), ((0, 0, 1), (1, 0, 1)), ((0, 0, 1), (0, 1, 1)),
)  # fmt: skip


def block(cells: int = 2, fixed: bool = False, seed: int = 0) -> tuple[LinkMesh, Array]:
    """A cube of ``cells``³ unit cells split into tetrahedra along one diagonal, its nodes displaced; and its masses."""
    n = cells + 1
    rest = np.stack(np.meshgrid(*[np.arange(n, dtype=np.float64)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(n**3).reshape(n, n, n)
    paths = [((0, 0, 0), a, b, (1, 1, 1)) for a, b in DIAGONAL_PATHS]
    tetrahedra = np.array(
        [[index[tuple(np.add(cell, c))] for c in path] for cell in np.ndindex(*[cells] * 3) for path in paths]
    )
    rest += np.random.default_rng(seed).uniform(-0.15, 0.15, rest.shape)
    links, k = stiffness_from_modulus(rest, tetrahedra, 100.0)
    bottom = rest[:, 2] < 0.3 if fixed else np.zeros(len(rest), dtype=bool)
    return link_mesh(rest, links, k, bottom), lumped_masses(rest, tetrahedra, 1e-6)


def in_motion(mesh: LinkMesh, speed: float = 50.0, seed: int = 1) -> State:
    """Rest positions, random velocities of the free nodes."""
    state = at_rest(mesh)
    state.v[:] = np.where(mesh.fixed[:, None], 0.0, np.random.default_rng(seed).normal(scale=speed, size=state.v.shape))
    return state
