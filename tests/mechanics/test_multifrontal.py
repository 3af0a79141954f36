"""Nested dissection and the multifrontal factor: every node once, no fill between the parts, and K x = f solved."""

from __future__ import annotations

import numpy as np
import pytest
from allocations import kept_bytes

from trainer.geometry import Array
from trainer.mechanics import substitution
from trainer.mechanics.links import LinkMesh, blocks, hessian, link_mesh
from trainer.mechanics.multifrontal import GROUP, PANEL, TILE, Multifrontal, eliminate
from trainer.mechanics.nested_dissection import Fronts, dissect


def block(cells: tuple[int, int, int] = (6, 3, 3)) -> LinkMesh:
    """A grid of nodes with links to all neighbours of the 26, fixed at x = 0; its nodes in no order."""
    at = np.stack(np.meshgrid(*(np.arange(c + 1) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    at = at[np.random.default_rng(3).permutation(len(at))]
    i, j = np.nonzero(np.triu(np.max(np.abs(at[:, None] - at[None]), axis=2) == 1))
    return link_mesh(at.astype(float), np.stack([i, j], axis=1), np.ones(len(i)), at[:, 0] == 0)


def two_apart() -> LinkMesh:
    """Two meshes without a link between them."""
    one = block((3, 2, 2))
    rest = np.concatenate([one.rest, one.rest + 20.0])
    links = np.concatenate([one.links, one.links + len(one.rest)])
    return link_mesh(rest, links, np.ones(len(links)), np.tile(one.fixed, 2))


def rows_of(fronts: Fronts, s: int) -> np.ndarray:
    return fronts.row[fronts.row_start[s] : fronts.row_start[s + 1]]


@pytest.mark.parametrize("mesh", [block(), block((12, 1, 1)), two_apart()], ids=["block", "bar", "two"])
@pytest.mark.parametrize("leaf", [1, 4, 16, 1000])
def test_fronts_hold_every_link_and_pass_on_what_they_leave(mesh: LinkMesh, leaf: int) -> None:
    """Each free node is a pivot once; a link's nodes meet in its front; a front's rows are in its parent's front."""
    fronts = dissect(mesh, leaf)
    assert sorted(fronts.order.tolist()) == np.flatnonzero(~mesh.fixed).tolist()
    assert np.array_equal(fronts.order[fronts.place[fronts.order]], fronts.order)
    for s, parent in enumerate(fronts.parent):
        rows = rows_of(fronts, s)
        assert np.all(np.diff(rows) > 0)
        assert parent > s or (parent == -1 and len(rows) == 0)
        if parent >= 0:
            above = {*range(fronts.first[parent], fronts.first[parent + 1]), *rows_of(fronts, int(parent)).tolist()}
            assert set(rows.tolist()) <= above
        here = {-1, *range(fronts.first[s], fronts.first[s + 1]), *rows.tolist()}
        for e in fronts.link[fronts.link_start[s] : fronts.link_start[s + 1]]:
            assert set(fronts.place[mesh.links[e]].tolist()) <= here
    moving = np.any(fronts.place[mesh.links] >= 0, axis=1)
    gathered = fronts.link[: fronts.link_start[-1]] if len(fronts.link) else fronts.link
    assert set(np.flatnonzero(moving).tolist()) <= set(fronts.link.tolist())
    assert len(set(gathered.tolist())) == len(gathered)


@pytest.mark.parametrize("size", [3, GROUP + 1, PANEL + 6, TILE + PANEL + 9])
def test_elimination_leaves_the_schur_complement(size: int) -> None:
    """A = [[B, Cᵀ], [C, D]] leaves D - C B⁻¹ Cᵀ, and rows D Lᵀ of B; rounding grows no faster than with the size."""
    rng = np.random.default_rng(size)
    half = rng.normal(size=(size, size))
    a = half @ half.T + size * np.eye(size)
    pivots = 3 * ((2 * size) // 9) or 3
    work, inverse = np.triu(a).ravel().copy(), np.zeros(pivots)
    scratch = np.zeros(PANEL * TILE), np.zeros(4 * GROUP)
    assert eliminate(work, size, pivots, inverse, np.diagonal(a).copy(), 1e-9, *scratch) == 0
    left = np.triu(work.reshape(size, size)[pivots:, pivots:])
    expected = a[pivots:, pivots:] - a[pivots:, :pivots] @ np.linalg.solve(a[:pivots, :pivots], a[:pivots, pivots:])
    assert np.allclose(left, np.triu(expected), rtol=0.0, atol=1e-14 * size * np.max(np.abs(a)))
    upper = np.triu(work.reshape(size, size)[:pivots, :pivots])
    rebuilt = upper.T @ (inverse[:, None] * upper)
    assert np.allclose(rebuilt, a[:pivots, :pivots], rtol=0.0, atol=1e-14 * size * np.max(np.abs(a)))


def free_stiffness(mesh: LinkMesh, fronts: Fronts) -> Array:
    at = (3 * fronts.order[:, None] + np.arange(3)).ravel()
    return hessian(mesh, mesh.rest)[np.ix_(at, at)]


@pytest.mark.parametrize("mesh", [block(), two_apart()], ids=["block", "two"])
@pytest.mark.parametrize("leaf", [1, 16, 1000])
def test_a_solve_is_that_of_the_dense_matrix(mesh: LinkMesh, leaf: int) -> None:
    """Kept in single precision: right to its rounding, 6e-8, times the matrix's condition, times ten."""
    fronts = dissect(mesh, leaf)
    work = Multifrontal(mesh.links, fronts)
    assert work.compute(blocks(mesh, mesh.rest))
    force = np.random.default_rng(0).normal(size=mesh.rest.shape)
    out = np.zeros_like(force)
    work.solve(force, out)
    stiffness = free_stiffness(mesh, fronts)
    expected = np.linalg.solve(stiffness, force[fronts.order].ravel()).reshape(-1, 3)
    error = np.linalg.norm(out[fronts.order] - expected) / np.linalg.norm(expected)
    assert error <= 10.0 * 6e-8 * np.linalg.cond(stiffness)
    assert np.all(out[mesh.fixed] == 0.0)


def test_a_matrix_that_is_not_positive_definite_is_told() -> None:
    mesh = block()
    work = Multifrontal(mesh.links, dissect(mesh))
    assert not work.compute(-blocks(mesh, mesh.rest))
    assert not work.compute(blocks(mesh, 0.3 * mesh.rest))  # shortened links push their ends aside
    assert work.compute(blocks(mesh, mesh.rest)), "and the next one is as good as the first"


def test_a_surface_costs_less_than_a_band() -> None:
    """f log f numbers in the factor instead of f^1.5: four times as many nodes take at most six times as many."""
    numbers = [len(Multifrontal(m.links, dissect(m)).factor.panel) for m in (block((15, 15, 1)), block((31, 31, 1)))]
    assert numbers[1] < 6.0 * numbers[0]


def test_a_solve_allocates_nothing() -> None:
    """Beyond what the interpreter needs for a call: far less than one vector of the mesh."""
    mesh = block()
    work = Multifrontal(mesh.links, dissect(mesh))
    work.compute(blocks(mesh, mesh.rest))
    force, out = np.ones_like(mesh.rest), np.zeros_like(mesh.rest)
    work.solve(force, out)
    _, most = kept_bytes(lambda: substitution.solve(work.factor, force, *work.scratch, out))
    assert most < force.nbytes
