"""An old factor of a mesh's stiffness made good where the mesh has changed most: near the nodes that are held.

A factor of an earlier stiffness M answers most of a new one A: the two differ where links have turned or stretched
since, which is near the instrument. There, on the nodes S nearest to the held ones, a factor B of the new stiffness
itself is cheap. The two take turns at what the other leaves over (symmetric multiplicative Schwarz: Smith, Bjørstad and
Gropp, Domain Decomposition, section 1.3):

    z ← B⁻¹ r,    z ← z + M⁻¹ (r - A z),    z ← z + B⁻¹ (r - A z).

The whole is symmetric, and positive definite where 2 B > A on S, whatever M is: so B has the exact stiffness of S, or,
where that is not positive definite, the positive part of each link's, which is above it.

Held nodes do not change the factor M, which is of all nodes that are not fixed for good. Its inverse restricted to the
others is

    K_ff⁻¹ r = K⁻¹ r - K⁻¹ E (Eᵀ K⁻¹ E)⁻¹ Eᵀ K⁻¹ r

with the unit columns E of the held nodes' coordinates.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from trainer.geometry import Array
from trainer.mechanics.link_tension import Branch
from trainer.mechanics.links import LinkMesh, blocks, link_blocks
from trainer.mechanics.multifrontal import Multifrontal
from trainer.mechanics.nested_dissection import dissect
from trainer.mechanics.quasi_newton import add_scaled
from trainer.mechanics.substitution import MultifrontalFactor, solve

#: The nodes near the held ones, as a share of all: their factor costs a hundredth of that of all, half an iteration.
NEAR = 1.0 / 24.0


class Kept(NamedTuple):
    """What the kernels read; ``share`` and those after it they overwrite."""

    free: np.ndarray  # (n,) bool
    whole: MultifrontalFactor  # M
    held: np.ndarray  # (h,) int64
    columns: Array  # (3 h, n, 3) mm/mN, K⁻¹ E
    inverse: Array  # (3 h, 3 h) mN/mm, (Eᵀ K⁻¹ E)⁻¹
    near: MultifrontalFactor  # B
    near_link: np.ndarray  # int32, the links that have a node in S
    share: Array  # (3 h,)
    left: Array  # (n, 3)
    v: np.ndarray  # (3 f,) float32, and the next: scratch of solves with M, and with B
    w: np.ndarray
    near_v: np.ndarray
    near_w: np.ndarray


class Preconditioner:
    """Approximate inverse of the stiffness of a mesh's free nodes, some of which are held."""

    def __init__(self, mesh: LinkMesh) -> None:
        """Raises ValueError when the links leave nodes free to move."""
        self.mesh = mesh
        self.free = ~mesh.fixed
        self._whole = Multifrontal(mesh.links, dissect(mesh))
        if not self._whole.compute(blocks(mesh, mesh.rest)):
            raise ValueError("the links do not hold all free nodes in place: the stiffness matrix is singular")
        self._held = np.zeros(0, dtype=np.int64)
        self._find_near()
        self._answer()

    @property
    def factor_bytes(self) -> int:
        """What an application reads twice."""
        return self._whole.factor.panel.nbytes

    @property
    def held_bytes(self) -> int:
        """What an application reads of memory, at least: the factors and the columns."""
        near = self._near.factor.panel
        return int(self.factor_bytes + near.nbytes + self.kept.columns.nbytes)

    @property
    def operations(self) -> float:
        """Multiplications that a new factor of the whole takes, for each number in it."""
        return self._whole.operations / max(1, len(self._whole.factor.panel))

    def hold(self, nodes: np.ndarray) -> None:
        """Takes ``nodes`` (k,) out of the unknowns."""
        self.free[:] = ~self.mesh.fixed
        self.free[nodes] = False
        held = np.flatnonzero(~self.free & ~self.mesh.fixed)
        if not np.array_equal(held, self._held):
            self._held = held
            self._find_near()
            self._answer()

    def renew(self, x: Array, block: Array, branch: Branch | None = None) -> None:
        """A new factor of the whole, of the stiffness at ``x`` (n, 3), or above it; overwrites ``block`` (m, 3, 3)."""
        m = self.mesh
        for positive_part in (False, True):
            link_blocks(x, m.links, m.rest_length, m.stiffness, positive_part, block, branch)
            if self._whole.compute(block):
                break
        self._answer()

    def update(self, x: Array, block: Array, branch: Branch | None = None) -> None:
        """``block`` (m, 3, 3) becomes the stiffness at ``x`` (n, 3), and the factor near the held nodes is of it.

        ``branch`` says where on their law the links are, if the mesh has one: here and above.
        """
        m = self.mesh
        link_blocks(x, m.links, m.rest_length, m.stiffness, False, block, branch)
        if not self._near.compute(block):
            link_blocks(x, m.links, m.rest_length, m.stiffness, True, block, branch)
            if not self._near.compute(block):
                self._near.factor.inverse[:] = 0.0  # B⁻¹ = 0: the factor of the whole alone
                self._near.factor.panel[:] = np.float32(0.0)
            link_blocks(x, m.links, m.rest_length, m.stiffness, False, block, branch)

    def _find_near(self) -> None:
        """The nodes S, and their place in the factor B."""
        m, near = self.mesh, np.zeros_like(self.free)
        others = np.flatnonzero(self.free)
        if len(self._held):
            distance = cKDTree(m.rest[self._held]).query(m.rest[others])[0]
            near[others[np.argsort(distance, kind="stable")[: int(NEAR * len(others))]]] = True
        self._near = Multifrontal(m.links, dissect(replace(m, fixed=~near)))
        i, j = m.links.T
        u, shape = 3 * len(self._held), m.rest.shape
        self.kept = Kept(
            self.free, self._whole.factor, self._held, np.zeros((u, *shape)), np.zeros((u, u)), self._near.factor,
            np.flatnonzero(near[i] | near[j]).astype(np.int32), np.zeros(u), np.zeros(shape), *self._whole.scratch,
            *self._near.scratch,
        )  # fmt: skip

    def _answer(self) -> None:
        """How the mesh answers to unit forces on the held nodes, by the factor of the whole."""
        held, columns, unit = self._held, self.kept.columns, self.kept.left
        unit[:] = 0.0
        for k in range(len(columns)):
            unit[held[k // 3], k % 3] = 1.0
            self._whole.solve(unit, columns[k])
            unit[held[k // 3], k % 3] = 0.0
        answer = columns[:, held].reshape(len(columns), len(columns))
        self.kept.inverse[:] = np.linalg.inv(0.5 * (answer + answer.T))


@njit(cache=True, nogil=True, error_model="numpy")
def precondition(kept: Kept, block: Array, links: np.ndarray, r: Array, z: Array) -> None:
    """``z`` (n, 3) mm answers to the forces ``r`` (n, 3) mN on the free nodes, under the stiffness ``block``."""
    near, left = kept.near.fronts.order, kept.left
    z[:] = 0.0
    solve(kept.near, r, kept.near_v, kept.near_w, z)
    left[:] = r
    _subtract_product(block, links, kept.near_link, z, left)
    _solve_free(kept, left)
    add_scaled(1.0, left, z, 0, len(z))
    for i in near:
        left[i, 0], left[i, 1], left[i, 2] = r[i, 0], r[i, 1], r[i, 2]
    _subtract_product(block, links, kept.near_link, z, left)
    solve(kept.near, left, kept.near_v, kept.near_w, left)
    for i in near:
        z[i, 0] += left[i, 0]
        z[i, 1] += left[i, 1]
        z[i, 2] += left[i, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_free(kept: Kept, values: Array) -> None:
    """Overwrites ``values`` (n, 3) with M⁻¹ of them, restricted to the free nodes."""
    for i in range(len(values)):
        if not kept.free[i]:
            values[i, 0] = values[i, 1] = values[i, 2] = 0.0
    solve(kept.whole, values, kept.v, kept.w, values)
    held, share = kept.held, kept.share
    for i in range(len(share)):
        share[i] = 0.0
        for j in range(len(share)):
            share[i] += kept.inverse[i, j] * values[held[j // 3], j % 3]
    for i in range(len(share)):
        add_scaled(-share[i], kept.columns[i], values, 0, len(values))
    for i in held:
        values[i, 0] = values[i, 1] = values[i, 2] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract_product(block: Array, links: np.ndarray, chosen: np.ndarray, v: Array, out: Array) -> None:
    """Takes the product of the stiffness of the links ``chosen`` with ``v`` (n, 3) off ``out`` (n, 3)."""
    for e in chosen:
        i, j = links[e, 0], links[e, 1]
        d0, d1, d2 = v[i, 0] - v[j, 0], v[i, 1] - v[j, 1], v[i, 2] - v[j, 2]
        for c in range(3):
            f = block[e, c, 0] * d0 + block[e, c, 1] * d1 + block[e, c, 2] * d2
            out[i, c] -= f
            out[j, c] += f
