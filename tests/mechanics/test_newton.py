"""Newton's methods for static equilibrium and block sweeps: the same answers, whatever is done to a mesh."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from allocations import ARRAY_HEADER, kept_bytes

from trainer.geometry import Array
from trainer.mechanics.krylov import NewtonKrylov
from trainer.mechanics.links import LinkMesh, blocks, diagonal_blocks, energy, forces, hessian, link_mesh
from trainer.mechanics.newton import Newton, Pattern
from trainer.mechanics.sweeps import BlockSweeps

METHODS = [Newton, NewtonKrylov, BlockSweeps]
Kind = type[Newton] | type[NewtonKrylov] | type[BlockSweeps]


def block(cells: tuple[int, int, int] = (5, 2, 2), ratio: float = 1.0) -> LinkMesh:
    """A grid of nodes with links to all neighbours of the 26, fixed at x = 0; half the links stiffer by ``ratio``."""
    at = np.stack(np.meshgrid(*(np.arange(c + 1) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    i, j = np.nonzero(np.triu(np.max(np.abs(at[:, None] - at[None]), axis=2) == 1))
    stiffness = np.where(np.arange(len(i)) % 2 == 0, 1.0, ratio)
    return link_mesh(at.astype(float), np.stack([i, j], axis=1), stiffness, at[:, 0] == 0)


def corner(mesh: LinkMesh) -> np.ndarray:
    return np.array([len(mesh.rest) - 1])


def free_of(mesh: LinkMesh, moved: np.ndarray) -> np.ndarray:
    return np.setdiff1d(np.flatnonzero(~mesh.fixed), moved)


def softest(mesh: LinkMesh, x: Array, free: np.ndarray) -> float:
    """The smallest eigenvalue, mN/mm, of the stiffness of the free nodes: above zero where it is stable."""
    at = (3 * free[:, None] + np.arange(3)).ravel()
    return float(np.linalg.eigvalsh(hessian(mesh, x)[np.ix_(at, at)])[0])


@pytest.mark.parametrize("ratio", [1.0, 1e6])
def test_all_methods_reach_the_same_stable_equilibrium(ratio: float) -> None:
    """A residual r leaves a node within r / λ of the equilibrium, λ the softest stiffness, to first order; two answers
    within twice that, and twice again for the second order."""
    mesh = block(ratio=ratio)
    node = corner(mesh)
    place = mesh.rest[node] + [0.3, 0.4, -0.2]
    tolerance = 1e-7
    answers = []
    for kind in METHODS:
        method = kind(mesh)
        ended = method.move(node, place, tolerance_mN=tolerance)
        assert ended.converged
        assert np.linalg.norm(forces(mesh, method.x)[free_of(mesh, node)]) <= tolerance
        assert ended.energy == pytest.approx(energy(mesh, method.x), rel=1e-12)
        answers.append(method.x)
    stiffness = softest(mesh, answers[0], free_of(mesh, node))
    assert stiffness > 0.0
    for x in answers[1:]:
        assert np.max(np.linalg.norm(x - answers[0], axis=1)) <= 4.0 * tolerance / stiffness


def test_the_sparse_stiffness_is_that_of_the_free_nodes() -> None:
    """All entries are sums of at most 26 numbers of the size of a link's stiffness: 26 roundings."""
    mesh = block(ratio=3.0)
    rng = np.random.default_rng(0)
    for moved in ([7], [40, 30], []):
        free = free_of(mesh, np.array(moved, dtype=int))
        chosen = np.isin(np.arange(len(mesh.rest)), free)
        pattern = Pattern(mesh.links, chosen)
        at = (3 * free[:, None] + np.arange(3)).ravel()
        for shift in (0.0, 0.5):
            x = mesh.rest + 0.1 * rng.normal(size=mesh.rest.shape)
            dense = hessian(mesh, x)[np.ix_(at, at)] + shift * np.eye(len(at))
            assert np.abs(pattern.fill(blocks(mesh, x), shift).toarray() - dense).max() < 26 * 3.0 * 2.0**-52


@pytest.mark.parametrize("kind", [Newton, NewtonKrylov])
def test_a_linear_mesh_needs_the_predictor_only(kind: Kind) -> None:
    """Links stretched along one line have constant stiffness there: the tangent is the path, to the accuracy asked of
    the first linear solve (0.1 of the residual for conjugate gradients, rounding for the direct one)."""
    x = np.zeros((12, 3))
    x[:, 0] = np.arange(12.0)
    links = np.stack([np.arange(11), np.arange(1, 12)], axis=1)
    mesh = link_mesh(x, links, np.ones(11), np.isin(np.arange(12), [11]))
    mesh = replace(mesh, rest_length=0.5 * mesh.rest_length)
    method = kind(mesh)
    method.move(np.array([0]), mesh.rest[:1], tolerance_mN=1e-12)
    ended = method.move(np.array([0]), np.array([[-1.0, 0.0, 0.0]]), tolerance_mN=1e-9)
    assert ended.converged
    assert ended.steps <= (0 if kind is Newton else 2)
    assert np.allclose(method.x[:, 0], np.linspace(-1.0, 11.0, 12), atol=1e-8)


@pytest.mark.parametrize("kind", METHODS)
def test_no_step_raises_the_energy(kind: Kind) -> None:
    """Ended after one step more each time, the energy only falls; rounding of its sum is 1e-13 of it."""
    mesh = block()
    node = corner(mesh)
    place = mesh.rest[node] + [-1.5, -2.5, 1.0]
    seen = []
    for steps in range(24):
        method = kind(mesh)
        limit = {"most_sweeps": steps} if kind is BlockSweeps else {"most_steps": steps}
        ended = method.move(node, place, tolerance_mN=1e-9, **limit)  # type: ignore[arg-type]
        assert np.isfinite(method.x).all()
        seen.append(ended.energy)
    moved = mesh.rest.copy()
    moved[node] = place
    assert seen[0] <= energy(mesh, moved)
    assert all(b <= a * (1.0 + 1e-13) for a, b in pairwise(seen))
    assert seen[-1] < 0.5 * energy(mesh, moved)


@pytest.mark.parametrize("kind", METHODS)
def test_a_load_is_balanced(kind: Kind) -> None:
    """Under forces on the nodes their elastic forces are equal and opposite."""
    mesh = block()
    load = np.zeros_like(mesh.rest)
    load[:, 2] = -0.005
    method = kind(mesh)
    assert method.move(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), tolerance_mN=1e-9, load=load).converged
    free = free_of(mesh, np.zeros(0, dtype=np.int64))
    assert np.linalg.norm((forces(mesh, method.x) + load)[free]) <= 1e-9
    assert np.mean(method.x[:, 2] - mesh.rest[:, 2]) < -0.01


@pytest.mark.parametrize("kind", METHODS)
def test_what_has_no_answer_is_refused(kind: Kind) -> None:
    mesh = block()
    method = kind(mesh)
    node = corner(mesh)
    before = method.x.copy()
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="not finite"):
            method.move(node, np.array([[bad, 0.0, 0.0]]), tolerance_mN=1e-6)
        with pytest.raises(ValueError, match="load is not finite"):
            method.move(node, mesh.rest[node], tolerance_mN=1e-6, load=np.full_like(mesh.rest, bad))
    assert np.array_equal(method.x, before)
    lonely = link_mesh(
        np.vstack([mesh.rest, [[9.0, 9.0, 9.0]]]), mesh.links, mesh.stiffness, np.append(mesh.fixed, False)
    )
    with pytest.raises(ValueError, match=f"node {len(mesh.rest)} is neither fixed nor linked"):
        kind(lonely)


@pytest.mark.parametrize("kind", METHODS)
def test_links_of_no_length_and_in_one_line(kind: Kind) -> None:
    """A node is put exactly onto its neighbour: finite, and in equilibrium or said not to be."""
    mesh = block()
    node = corner(mesh)
    onto = mesh.rest[node - 1]
    method = kind(mesh)
    ended = method.move(node, onto, tolerance_mN=1e-7)
    assert np.isfinite(method.x).all()
    left = np.linalg.norm(forces(mesh, method.x)[free_of(mesh, node)])
    assert left == pytest.approx(ended.residual_mN, rel=1e-9)
    assert ended.converged == bool(left <= 1e-7)


def test_a_mesh_that_hangs_loose_is_refused_at_once() -> None:
    """A straight chain has no stiffness across: its factor cannot be kept."""
    x = np.zeros((4, 3))
    x[:, 0] = np.arange(4.0)
    mesh = link_mesh(x, np.array([[0, 1], [1, 2], [2, 3]]), np.ones(3), np.arange(4) == 0)
    with pytest.raises(ValueError, match="singular"):
        NewtonKrylov(mesh)


def test_a_fold_is_passed_by_the_region_of_trust() -> None:
    """A shallow roof of two links snaps through under its ridge: beyond the fold the energy curves down until it is
    through. The ridge is free, its height is loaded beyond the fold; the only equilibrium hangs below."""
    x = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.2], [0.0, -1.0, 0.2], [0.0, 1.0, 0.2]])
    links = np.array([[0, 2], [1, 2], [3, 2], [4, 2]])
    mesh = link_mesh(x, links, np.array([10.0, 10.0, 1e-3, 1e-3]), np.array([True, True, False, True, True]))
    load = np.zeros_like(x)
    load[2, 2] = -0.5
    nothing = (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    for kind in METHODS:
        method = kind(mesh)
        assert method.move(*nothing, tolerance_mN=1e-9, load=load).converged
        assert method.x[2, 2] < -0.2
        assert np.linalg.eigvalsh(diagonal_blocks(mesh, method.x)[2])[0] > 0.0


def drawn(kind: Kind) -> Array:
    mesh = block()
    node = corner(mesh)
    method = kind(mesh)
    for k in range(1, 6):
        method.move(node, mesh.rest[node] + 0.1 * k * np.array([0.5, 1.0, -0.3]), tolerance_mN=1e-8)
    return method.x


@pytest.mark.parametrize("kind", METHODS)
def test_the_same_bits_again_and_in_several_threads_at_once(kind: Kind) -> None:
    once = drawn(kind)
    found: list[Array] = []
    threads = [threading.Thread(target=lambda: found.append(drawn(kind))) for _ in range(3)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert len(found) == 3
    assert all(np.array_equal(x, once) for x in found)


def test_a_frame_of_newton_krylov_allocates_nothing() -> None:
    """Beyond what the interpreter needs for calls, and a few flags for each node: less than one vector of the mesh."""
    mesh = block((15, 6, 6))
    node = corner(mesh)
    method = NewtonKrylov(mesh)
    ends = [mesh.rest[node] + [0.0, way, 0.0] for way in (0.1, 0.2)]

    def out_and_back() -> None:
        for place in ends:
            assert method.move(node, place, tolerance_mN=1e-3).converged

    kept, most = kept_bytes(out_and_back)
    assert kept < ARRAY_HEADER
    assert most < mesh.rest.nbytes


def test_without_compilation_the_same_answer(tmp_path: Path) -> None:
    """The compiler may reorder one sum (substitution), which steers the iterations; all end at the same residual.

    It leaves a node within 1e-10 mN over the softest stiffness, 0.1 mN/mm and more here.
    """
    script = (
        "import sys, numpy; sys.path[:0] = sys.argv[1:2]; import test_newton as t; numpy.save(sys.argv[2], t.tiny())"
    )
    run = [sys.executable, "-c", script, str(Path(__file__).parent), str(tmp_path / "tiny.npy")]
    subprocess.run(run, check=True, env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, timeout=120)
    assert np.allclose(np.load(tmp_path / "tiny.npy"), tiny(), rtol=0.0, atol=1e-9)


def tiny() -> Array:
    """All methods on a mesh of a few nodes."""
    mesh = block((2, 1, 1))
    node = corner(mesh)
    out = []
    for kind in METHODS:
        method = kind(mesh)
        method.move(node, mesh.rest[node] + [0.1, 0.2, 0.1], tolerance_mN=1e-10)
        out.append(method.x)
    return np.array(out)
