"""The quasi-static relaxation of Brown et al. 2001, section 3, as published.

Equation (2), Σ F_ij + external force = 0 at every variable node, is solved by sweeps: each node in turn moves along
the force on it, x_i ← x_i + α f_i. The nodes are visited breadth first from those that the user has moved, so that a
force travels through the whole mesh within a sweep; a sweep may be limited to the nodes within a number of links of
the moved ones, and may stop spreading where forces fall below a threshold.

The paper chooses one α by trial, "as large as possible such that the iteration converges". A fixed one that suits a
mesh of 2000 nodes diverges at 300 and at 20 000; here α_i = c / Σ_j k_ij over the node's links. Σ k is the trace of the
node's stiffness block, so that c = 1 is at most half of what the node's own iteration converges with: it needs no
trial. ``factor_by_trial`` finds the c of one mesh as the paper does. Where k_ij is a function of the elongation, as the
paper allows, its place is taken by the steepest that the link can become: then the same holds wherever the nodes go.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.link_law import steepest_tangent
from trainer.mechanics.link_tension import Branch, tension_of
from trainer.mechanics.links import LinkMesh, never_stretched

#: Sweeps between two looks at the residual and the time.
SWEEPS_PER_LOOK = 10
#: How much larger each factor is than the one tried before.
TRIAL = 0.5


@dataclass(frozen=True)
class Relaxation:
    """How a relaxation ended."""

    converged: bool
    sweeps: int
    residual_mN: float  # Euclidean norm of the forces on the nodes that the sweeps visit


def breadth_first(mesh: LinkMesh, moved: np.ndarray, most_links: int | None = None) -> np.ndarray:
    """The variable nodes (r,) int32 by their distance in links from the nodes ``moved`` (k,), nearest first.

    Moved and fixed nodes are not in it; nor are nodes further away than ``most_links``, where that is given.
    """
    distance = np.full(len(mesh.rest), -1, dtype=np.int64)
    distance[moved] = 0
    frontier = [int(i) for i in moved]
    order: list[int] = []
    while frontier and (most_links is None or distance[frontier[0]] < most_links):
        reached = []
        for i in frontier:
            for j in mesh.neighbour[mesh.start[i] : mesh.start[i + 1]]:
                if distance[j] < 0:
                    distance[j] = distance[i] + 1
                    reached.append(int(j))
        order += [j for j in reached if not mesh.fixed[j]]
        frontier = reached
    return np.array(order, dtype=np.int32)


@njit(cache=True, nogil=True, error_model="numpy")
def sweep(
    x: Array,
    order: np.ndarray,
    start: np.ndarray,
    neighbour: np.ndarray,
    via: np.ndarray,
    rest_length: Array,
    stiffness: Array,
    steepest: Array,
    load: Array,
    cut_off_mN: float,
    reached: np.ndarray,
    branch: Branch | None,
    factor: float,
) -> float:
    """One Gauss–Seidel sweep over ``order``; returns the Euclidean norm of the forces that it met, mN.

    ``reached`` (n,) bool says which nodes a force has come to; a node passes it on when the force on it is at least
    ``cut_off_mN``, and is left alone before. ``steepest`` (m,) mN/mm is the largest derivative of each link's tension.
    """
    total = 0.0
    for i in order:
        if not reached[i]:
            continue
        fx, fy, fz = load[i, 0], load[i, 1], load[i, 2]
        trace = 0.0
        for entry in range(start[i], start[i + 1]):
            j, e = neighbour[entry], via[entry]
            dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            trace += steepest[e]
            if length > 0.0:
                tension, _ = tension_of(e, length - rest_length[e], stiffness, branch)
                pull = tension / length
                fx += pull * dx
                fy += pull * dy
                fz += pull * dz
        squared = fx * fx + fy * fy + fz * fz
        total += squared
        if squared < cut_off_mN * cut_off_mN:
            continue
        x[i, 0] += factor * fx / trace
        x[i, 1] += factor * fy / trace
        x[i, 2] += factor * fz / trace
        for entry in range(start[i], start[i + 1]):
            reached[neighbour[entry]] = True
    return math.sqrt(total)


def relax(
    mesh: LinkMesh,
    x: Array,
    moved: np.ndarray,
    *,
    tolerance_mN: float,
    most_sweeps: int,
    load: Array | None = None,
    most_links: int | None = None,
    cut_off_mN: float = 0.0,
    out_of_time: Callable[[], bool] = lambda: False,
    branch: Branch | None = None,
    factor: float = 1.0,
) -> Relaxation:
    """Moves the variable nodes of ``x`` (n, 3), in place, towards equilibrium; the nodes ``moved`` (k,) stay.

    ``load`` (n, 3) mN is the external force on each node: gravity m_i g, a push. ``most_links`` and ``cut_off_mN``
    limit the region as in the paper. Ends when the residual is small enough, after ``most_sweeps``, or when
    ``out_of_time`` says so (the paper gives it 1/30 s); it is asked every few sweeps.
    The links of a mesh with a law were never stretched before, unless ``branch`` says so. ``factor``: c, above.
    """
    order = breadth_first(mesh, moved, most_links)
    load = np.zeros_like(x) if load is None else load
    branch = branch or never_stretched(mesh)
    steepest = mesh.stiffness if branch is None else steepest_tangent(branch.law)
    reached = np.any(load != 0.0, axis=1)
    for i in moved:
        reached[mesh.neighbour[mesh.start[i] : mesh.start[i + 1]]] = True
    if cut_off_mN == 0.0:
        reached[:] = True
    residual = math.inf
    done = 0
    while done < most_sweeps and not out_of_time():
        for _ in range(min(SWEEPS_PER_LOOK, most_sweeps - done)):
            residual = float(
                sweep(
                    x,
                    order,
                    mesh.start,
                    mesh.neighbour,
                    mesh.via,
                    mesh.rest_length,
                    mesh.stiffness,
                    steepest,
                    load,
                    cut_off_mN,
                    reached,
                    branch,
                    factor,
                )
            )
            done += 1
        if residual <= tolerance_mN:
            return Relaxation(True, done, residual)
    return Relaxation(False, done, residual)


def factor_by_trial(mesh: LinkMesh, x: Array, moved: np.ndarray, *, tolerance_mN: float, most_sweeps: int) -> float:
    """The largest factor of 1, 1.5, 2 … with which ``relax`` from ``x`` (n, 3) takes fewer sweeps than with the one
    before; ``most_sweeps`` for the first. Leaves ``x`` as it is."""
    best = factor = 1.0
    allowed = most_sweeps
    while True:
        trial = relax(mesh, x.copy(), moved, tolerance_mN=tolerance_mN, most_sweeps=allowed, factor=factor)
        if not trial.converged or (factor > 1.0 and trial.sweeps >= allowed):
            return best
        best, allowed = factor, trial.sweeps
        factor += TRIAL
