"""An old factor made good near the held nodes: its formula, and what Schwarz's method does to the spectrum."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from allocations import ARRAY_HEADER, kept_bytes

from trainer.geometry import Array
from trainer.mechanics import preconditioner
from trainer.mechanics.links import LinkMesh, hessian, link_mesh
from trainer.mechanics.preconditioner import Preconditioner, precondition

#: Rounding of single precision.
EPS = 6e-8


def block(cells: tuple[int, int, int] = (5, 2, 2)) -> LinkMesh:
    """A grid of nodes with links to all neighbours of the 26, fixed at x = 0."""
    at = np.stack(np.meshgrid(*(np.arange(c + 1) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    i, j = np.nonzero(np.triu(np.max(np.abs(at[:, None] - at[None]), axis=2) == 1))
    return link_mesh(at.astype(float), np.stack([i, j], axis=1), np.ones(len(i)), at[:, 0] == 0)


def drawn(mesh: LinkMesh, held: np.ndarray) -> Array:
    """The held nodes are drawn by half a link and those around them give way by less, the further away the less."""
    far = np.min(np.linalg.norm(mesh.rest[:, None] - mesh.rest[held], axis=2), axis=1)
    return mesh.rest + np.exp(-far)[:, None] * np.array([0.2, 0.4, -0.2]) * ~mesh.fixed[:, None]


def dense(base: Preconditioner, links: np.ndarray, links_block: Array) -> Array:
    """What it does to every unit force on a coordinate of a node, fixed and held ones included."""
    n = len(base.free)
    out, z, force = np.zeros((3 * n, 3 * n)), np.zeros((n, 3)), np.zeros((n, 3))
    for k in np.flatnonzero(np.repeat(base.free, 3)):
        force.reshape(-1)[k] = 1.0
        precondition(base.kept, links_block, links, force, z)
        out[:, k] = z.reshape(-1)
        force.reshape(-1)[k] = 0.0
    return out


@pytest.fixture
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the nodes of a small mesh are as many as the method is made for."""
    monkeypatch.setattr(preconditioner, "NEAR", 0.25)


def parts(mesh: LinkMesh, held: np.ndarray, x: Array) -> tuple[Array, Array, Array, Array]:
    """The preconditioner of ``mesh`` drawn to ``x``, and M, A, B⁻¹ that it should be made of, on the free nodes."""
    base = Preconditioner(mesh)
    links_block = np.zeros((len(mesh.links), 3, 3))
    base.hold(held)
    base.update(x, links_block)
    dof = np.flatnonzero(np.repeat(base.free, 3))
    whole = dense(base, mesh.links, links_block)
    others = np.setdiff1d(np.arange(len(whole)), dof)
    assert np.all(whole[others] == 0.0), "fixed and held nodes stay"
    a, m = (hessian(mesh, at)[np.ix_(dof, dof)] for at in (x, mesh.rest))
    inverse = np.zeros_like(a)
    near = np.isin(dof // 3, base.kept.near.fronts.order)
    inverse[np.ix_(near, near)] = np.linalg.inv(a[np.ix_(near, near)])
    return whole[np.ix_(dof, dof)], m, a, inverse


HELD = [[], [53], [50, 53]]


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("held", HELD)
def test_the_two_factors_take_turns(held: list[int]) -> None:
    """P = 2 B⁻¹ - B⁻¹ A B⁻¹ + (I - B⁻¹ A) M⁻¹ (I - A B⁻¹).

    Each solve is right to the rounding of single precision times the matrix's condition κ, times ten: the error is
    that of the three terms."""
    mesh, nodes = block(), np.array(held, dtype=np.int64)
    p, m, a, b = parts(mesh, nodes, drawn(mesh, nodes) if held else mesh.rest)
    left = np.eye(len(a)) - a @ b
    expected = 2.0 * b - b @ a @ b + left.T @ np.linalg.solve(m, left)
    size = 2.0 * np.linalg.norm(b, 2) + np.linalg.norm(left, 2) ** 2 / np.linalg.eigvalsh(m)[0]
    assert np.linalg.norm(p - expected, 2) <= 10.0 * EPS * np.linalg.cond(m) * size
    assert bool(np.any(b)) == bool(held), "with nothing held there is nothing near it"


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("held", HELD[1:])
def test_no_eigenvalue_gets_further_from_one(held: list[int]) -> None:
    """I - P A is I - M⁻¹ A between two projections that are orthogonal in the energy, so that its eigenvalues
    interlace with those of I - M⁻¹ A (Cauchy) or are zero: the spectrum of P A is within that of M⁻¹ A and 1. What
    sticks out most are links stretched near the held nodes, and they do so no more."""
    mesh, nodes = block(), np.array(held)
    p, m, a, _ = parts(mesh, nodes, drawn(mesh, nodes))
    assert np.linalg.eigvalsh(a)[0] > 0.0
    old, new = (np.sort(np.linalg.eigvals(matrix).real) for matrix in (np.linalg.solve(m, a), p @ a))
    error = 10.0 * EPS * np.linalg.cond(m) * old[-1]
    assert min(old[0], 1.0) - error <= new[0]
    assert new[-1] < old[-1] - error


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("shrunk", [0.995, 0.9, 0.3])
def test_it_is_positive_definite_where_the_stiffness_is_not(shrunk: float) -> None:
    """Shortened links push their ends aside. Conjugate gradients need symmetry, to rounding, and p · P p > 0."""
    mesh, nodes = block(), np.array([53])
    p, m, a, _ = parts(mesh, nodes, shrunk * mesh.rest)
    assert (np.linalg.eigvalsh(a)[0] < 0.0) == (shrunk < 0.95)
    assert np.linalg.norm(p - p.T, 2) <= 10.0 * EPS * np.linalg.cond(m) * np.linalg.norm(p, 2)
    assert np.linalg.eigvalsh(0.5 * (p + p.T))[0] > 0.0


def tiny() -> Array:
    """The preconditioner of a mesh of a few nodes."""
    mesh, nodes = block((3, 1, 1)), np.array([15])
    return parts(mesh, nodes, drawn(mesh, nodes))[0]


@pytest.mark.usefixtures("wide")
def test_without_compilation_the_same_numbers(tmp_path: Path) -> None:
    """But for rounding: the compiler may reorder one sum, and the matrix's condition is 2e2."""
    script = (
        "import sys, numpy; sys.path[:0] = sys.argv[1:2]; import test_preconditioner as t;"
        "t.preconditioner.NEAR = 0.25; numpy.save(sys.argv[2], t.tiny())"
    )
    run = [sys.executable, "-c", script, str(Path(__file__).parent), str(tmp_path / "tiny.npy")]
    subprocess.run(run, check=True, env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, timeout=120)
    here = tiny()
    assert np.linalg.norm(np.load(tmp_path / "tiny.npy") - here, 2) <= 10.0 * EPS * 2e2 * np.linalg.norm(here, 2)


def test_nothing_is_allocated_once_the_nodes_are_held() -> None:
    """Beyond what the interpreter needs for a call: far less than one vector of the mesh."""
    mesh = block((12, 6, 6))
    base = Preconditioner(mesh)
    links_block, z = np.zeros((len(mesh.links), 3, 3)), np.zeros_like(mesh.rest)
    held = np.array([len(mesh.rest) - 1])

    def work() -> None:
        base.hold(held)
        base.update(mesh.rest, links_block)
        precondition(base.kept, links_block, mesh.links, mesh.rest, z)

    kept, most = kept_bytes(work)
    assert kept < ARRAY_HEADER
    assert most < z.nbytes
