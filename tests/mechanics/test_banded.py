"""The kept factor against dense ones."""

from __future__ import annotations

import numpy as np
import pytest
from coarse_vessels import two_vessels

from trainer.anatomy.vessel import Tissue
from trainer.geometry import Array
from trainer.mechanics import banded
from trainer.mechanics.links import blocks, hessian


@pytest.fixture(scope="module")
def tissue() -> Tissue:
    return two_vessels()


def kept_factor(tissue: Tissue, number: type[np.floating], spared: int) -> tuple[banded.BandedFactor, Array]:
    """The kept factor of the second vessel without its last ``spared`` nodes, and its dense stiffness (3 f, 3 f)."""
    mesh = tissue.mesh
    order = tissue.orders()[1]
    order = order[: len(order) - spared]
    band, kept = banded.room(mesh.links, order, len(mesh.rest), number)
    assert banded.factor_blocks(blocks(mesh, mesh.rest), band, kept, banded.SINGULAR) == 0
    free = (3 * order[:, None] + np.arange(3)).ravel()
    return kept, hessian(mesh, mesh.rest)[np.ix_(free, free)]


def kept_lower(kept: banded.BandedFactor) -> Array:
    """L (3 f, 3 f) as the kept numbers say."""
    n, size, r = kept.below.shape
    lower = np.eye(size * n + r)
    numbers = kept.below * (kept.unit[:, :, None] * kept.share).astype(np.float64)
    for p in range(n):
        lower[size * (p + 1) : size * (p + 1) + r, size * p : size * (p + 1)] = numbers[p].T
    unknowns = 3 * len(kept.order)
    assert np.all(lower[unknowns:, :unknowns] == 0.0)  # nothing is kept of rows that the matrix has not
    return lower[:unknowns, :unknowns]


def kept_inverse(kept: banded.BandedFactor) -> Array:
    """D⁻¹ (3 f, 3 f) as the kept numbers say."""
    n, size, _ = kept.inverse.shape
    inverse = np.zeros((size * n, size * n))
    for p in range(n):
        inverse[size * p : size * (p + 1), size * p : size * (p + 1)] = kept.inverse[p]
    unknowns = 3 * len(kept.order)
    return inverse[:unknowns, :unknowns]


@pytest.mark.parametrize("spared", [0, 1])
def test_a_solve_is_the_dense_one_of_the_kept_numbers(tissue: Tissue, spared: int) -> None:
    """L⁻ᵀ D⁻¹ L⁻¹ g in single precision, for an even and an odd number of nodes.

    Rounding of 6e-8 in each of two times b = 158 sums per number, multiplied by what the substitutions amplify: no more
    than the square root of the condition number of 1e4 in each. That is 6e-8 sqrt(2 b) 1e2 = 1e-4.
    """
    kept, _ = kept_factor(tissue, np.float64, spared)
    load, answer = np.random.default_rng(0).normal(size=tissue.mesh.rest.shape), np.zeros_like(tissue.mesh.rest)
    banded.solve(kept, load, banded.scratch([kept]), answer)
    lower = kept_lower(kept)
    inner = kept_inverse(kept) @ np.linalg.solve(lower, load[kept.order].ravel())
    dense = np.linalg.solve(lower.T, inner)
    assert np.abs(answer[kept.order].ravel() - dense).max() < 1e-4 * np.abs(dense).max()
    assert np.all(answer[tissue.nodes(0)] == 0.0)


@pytest.mark.parametrize("spared", [0, 1])
@pytest.mark.parametrize("number", [np.float32, np.float64])
def test_the_factor_is_the_dense_one_to_eight_bits(tissue: Tissue, number: type[np.floating], spared: int) -> None:
    """Cholesky's G, by blocks: L = G diag(G)⁻¹, D = diag(G) diag(G)ᵀ.

    From a column's first row to any of its own, the numbers of one component are off by half of that row's unit in all:
    what rounding took from the others was passed on. A number at the limit cannot take it up, and one that is zero is
    none of the matrix's; the next does. Single precision's 6e-8 of an entry of 1, in 158 sums of either sign, is 1e-6;
    where the pivot of 0.4 of the diagonal is what is left of it, a few times that.
    """
    kept, stiffness = kept_factor(tissue, number, spared)
    g = np.linalg.cholesky(stiffness)
    lower, inverse, exact = kept_lower(kept), kept_inverse(kept), np.zeros_like(g)
    for first in range(0, len(g), banded.BLOCK):
        own = slice(first, min(first + banded.BLOCK, len(g)))
        square = g[own, own]
        assert np.linalg.norm(inverse[own, own] @ square @ square.T - np.eye(len(square))) < 1e-4
        exact[:, own] = g[:, own] @ np.linalg.inv(square)
    for j in range(len(g)):
        p, m = j // banded.BLOCK, j % banded.BLOCK
        rows = slice(banded.BLOCK * (p + 1), banded.BLOCK * (p + 1) + len(kept.share))
        for c in range(3):
            true, off = exact[rows, j][c::3], (lower[rows, j] - exact[rows, j])[c::3].cumsum()
            takes = (np.abs(kept.below[p, m, c::3][: len(true)]) < banded.LARGEST) & (np.abs(true) > 1e-6)
            half = 0.5 * (kept.unit[p, m] * kept.share[c::3])[: len(true)]
            assert np.all(np.abs(off)[takes] <= half[takes] + 1e-5)


def test_a_body_that_can_move_freely_is_refused(tissue: Tissue) -> None:
    mesh = tissue.mesh
    with pytest.raises(ValueError, match="do not hold all free nodes"):
        banded.factor(blocks(mesh, mesh.rest), mesh.links, np.arange(tissue.offset[1], dtype=np.int32), len(mesh.rest))
