"""Where a mesh comes to rest while one node is drawn: what the methods of a vessel are held against.

As far as can be waited for, by code that the methods do not share. Small meshes: a Newton's method of the bench's own,
without line search. Larger ones: Newton's method with SuperLU. The largest: a factor of SuperLU would take minutes, so
it is Newton–Krylov that answers, but along another way, beside that of the methods and in more steps, and to a smaller
residual. That shows that the answer does not depend on the way, and that a residual was small enough; an error of
Newton–Krylov's own code would not show there, but at the smaller sizes, where its rows are held against the others.
Once such an answer, at 200 344 nodes, was looked at by SuperLU: the stiffness there is positive definite, so that it
is stable, and Newton's step from it is 4e-11 radii long.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.sparse.linalg import spsolve

from trainer.geometry import Array
from trainer.mechanics.krylov import NewtonKrylov
from trainer.mechanics.links import LinkMesh, blocks, forces
from trainer.mechanics.newton import Newton, Pattern

#: Residual, mN, at which the bench's own Newton's method ends.
REFERENCE_mN = 1e-9
#: … and the two others, as a share of the first frame's.
REFERENCE_SHARE = 1e-9
#: Nodes up to which the bench's own method answers, and Newton's method with SuperLU.
OWN, DIRECT = 5_000, 50_000
#: The other way: its steps to each place, and how far it is beside the straight one, as a share of the step.
STEPS, BESIDE = 3, 0.25
BY_OWN = "a Newton's method of the bench's own"
BY_NEWTON = "Newton's method with SuperLU"
BY_ANOTHER_WAY = f"Newton–Krylov along another way in {STEPS} times the steps"


def answers(
    mesh: LinkMesh, node: int, places: Array, free: np.ndarray, first_mN: float, quick: bool = False
) -> tuple[Array, str]:
    """Where all nodes are (k, n, 3) mm when ``node`` is at each of its ``places`` (k, 3), and who says so.

    ``free`` (f,) are the nodes that move by themselves, ``first_mN`` the residual of the first frame. ``quick`` does
    not wait for SuperLU. Raises ArithmeticError where no answer is found to compare with.
    """
    nodes = len(mesh.rest)
    if nodes <= OWN:
        return _own(mesh, node, places, free), BY_OWN
    tolerance_mN = REFERENCE_SHARE * first_mN
    if nodes <= DIRECT and not quick:
        return _followed(Newton(mesh), node, [[place] for place in places], tolerance_mN), BY_NEWTON
    return _followed(NewtonKrylov(mesh), node, another_way(places), tolerance_mN), BY_ANOTHER_WAY


def another_way(places: Array) -> list[list[Array]]:
    """The places (3,) mm that lead to each of ``places`` (k, 3) beside the straight line, itself the last."""
    ways = [[places[0]]]
    for before, after in pairwise(places):
        way = after - before
        across = np.cross(way, np.eye(3)[np.argmin(np.abs(way))])
        aside = BESIDE * np.linalg.norm(way) / np.linalg.norm(across) * across
        ways.append([before + way * (k / STEPS) + aside for k in range(1, STEPS)] + [after])
    return ways


def _own(mesh: LinkMesh, node: int, places: Array, free: np.ndarray) -> Array:
    found, x = [], mesh.rest.copy()
    for place in places:
        x[node] = place
        converge(mesh, x, free)
        found.append(x.copy())
    return np.array(found)


def _followed(method: Newton | NewtonKrylov, node: int, ways: list[list[Array]], tolerance_mN: float) -> Array:
    found = []
    for way in ways:
        for place in way:
            if not method.move(np.array([node]), place[None], tolerance_mN=tolerance_mN).converged:
                raise ArithmeticError(f"{type(method).__name__} did not converge to the answer")
        found.append(method.x.copy())
    return np.array(found)


def residual_mN(mesh: LinkMesh, x: Array, free: np.ndarray) -> float:
    """Euclidean norm of the forces on the nodes ``free`` (f,) at ``x`` (n, 3)."""
    return float(np.linalg.norm(forces(mesh, x)[free]))


def converge(mesh: LinkMesh, x: Array, free: np.ndarray, most_steps: int = 30) -> None:
    """Newton's method on the nodes ``free`` (f,) of ``x`` (n, 3), in place, to a residual of REFERENCE_mN.

    Raises ArithmeticError when it does not get there: then there is nothing to compare with.
    """
    moves = np.zeros(len(x), dtype=bool)
    moves[free] = True
    pattern = Pattern(mesh.links, moves)
    for _ in range(most_steps):
        force = forces(mesh, x)[free].ravel()
        if np.linalg.norm(force) <= REFERENCE_mN:
            return
        x[free] += spsolve(pattern.fill(blocks(mesh, x)), force).reshape(-1, 3)
    raise ArithmeticError(f"Newton's method did not converge in {most_steps} steps")
