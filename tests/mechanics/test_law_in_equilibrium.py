"""Links with a law of their own in static equilibrium: each test states the law that it checks."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from trainer.geometry import Array
from trainer.mechanics.krylov import NewtonKrylov
from trainer.mechanics.link_law import constant, j_shaped, steepest_tangent
from trainer.mechanics.link_tension import Branch, area, loading
from trainer.mechanics.links import (
    LinkMesh,
    add_forces,
    blocks,
    energy,
    forces,
    hessian,
    link_mesh,
    never_stretched,
    settle,
)
from trainer.mechanics.newton import Newton, Outcome
from trainer.mechanics.relaxation import relax
from trainer.mechanics.sweeps import BlockSweeps

#: Growth per unit of strain, the toe's end, and the share lost: the tangent grows e^2 = 7.4 times.
GROWTH, TOE, LOSS = 5.0, 0.4, 0.3


class Relaxing:
    """The paper's relaxation, to be asked like the others."""

    def __init__(self, mesh: LinkMesh) -> None:
        self.mesh, self.x, self.branch = mesh, mesh.rest.copy(), never_stretched(mesh)

    def move(self, nodes: np.ndarray, places: Array, *, tolerance_mN: float, load: Array | None = None) -> Outcome:
        self.x[nodes] = places
        ended = relax(
            self.mesh, self.x, nodes, tolerance_mN=tolerance_mN, most_sweeps=100_000, load=load, branch=self.branch
        )  # fmt: skip
        return Outcome(ended.converged, ended.sweeps, ended.residual_mN, energy(self.mesh, self.x, self.branch))


Kind = type[Newton] | type[NewtonKrylov] | type[BlockSweeps] | type[Relaxing]
METHODS: list[Kind] = [Newton, NewtonKrylov, BlockSweeps, Relaxing]


def bar(links: int, loss: float) -> LinkMesh:
    """Nodes 2 mm apart along x, the first fixed; J-shaped links of 3 mN/mm at rest."""
    x = np.zeros((links + 1, 3))
    x[:, 0] = 2.0 * np.arange(links + 1)
    pairs = np.stack([np.arange(links), np.arange(1, links + 1)], axis=1)
    mesh = link_mesh(x, pairs, np.full(links, 3.0), np.arange(links + 1) == 0)
    return replace(mesh, law=j_shaped(mesh, GROWTH, TOE, loss))


def block(cells: tuple[int, int, int] = (3, 2, 2), loss: float = LOSS) -> LinkMesh:
    """A grid of nodes with links to all neighbours of the 26, fixed at x = 0; half the links stiffen twice as fast."""
    at = np.stack(np.meshgrid(*(np.arange(c + 1) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    i, j = np.nonzero(np.triu(np.max(np.abs(at[:, None] - at[None]), axis=2) == 1))
    mesh = link_mesh(at.astype(float), np.stack([i, j], axis=1), np.ones(len(i)), at[:, 0] == 0)
    growth = np.where(np.arange(len(i)) % 2 == 0, 0.5, 1.0) * GROWTH
    return replace(mesh, law=j_shaped(mesh, growth, TOE, loss))


def corner(mesh: LinkMesh) -> np.ndarray:
    return np.array([len(mesh.rest) - 1])


def elongation_at(tension: float, k: float, growth: float, toe: float) -> float:
    """The loading branch solved for the elongation, mm: ln(1 + β T / k) / β in the toe, then along the tangent."""
    most = k / growth * math.expm1(growth * toe)
    if tension <= most:
        return math.log1p(growth * tension / k) / growth
    return toe + (tension - most) / (k * math.exp(growth * toe))


@pytest.mark.parametrize("kind", [Newton, BlockSweeps, Relaxing])
def test_a_bar_under_load_follows_the_j_and_comes_back_along_the_other_branch(kind: Kind) -> None:
    """Each link of a bar carries the load P at its end. Loaded for the first time it is as long as T(Δ) = P says;
    after the links have settled and P has fallen far enough, as (1 - h) T(Δ) = P says; and loaded again as at first.

    The first two loads lie within the toe and beyond. Residuals r over n nodes leave a link's tension wrong by √n r at
    most, its length by √n r / k' with k' >= (1 - h) k, and the end by n times that. (``krylov`` refuses the bar: at
    rest it has no stiffness across.)
    """
    n, r = 4, 1e-9
    mesh = bar(n, LOSS)
    assert mesh.law is not None
    k, growth, toe, _, friction = (float(a[0]) for a in mesh.law)
    within, beyond = loading(0.5 * toe, k, growth, toe)[0], loading(1.5 * toe, k, growth, toe)[0]
    # It has left the friction between the branches when Δ is below the slip Δ_max - h T / κ.
    low = (1.0 - LOSS) * loading(1.5 * toe - 1.1 * LOSS * beyond / friction, k, growth, toe)[0]
    method = kind(mesh)
    load = np.zeros_like(mesh.rest)
    for pull, carried in ((within, within), (beyond, beyond), (low, low / (1.0 - LOSS)), (beyond, beyond)):
        load[-1, 0] = pull
        assert method.move(np.array([0]), mesh.rest[:1], tolerance_mN=r, load=load).converged
        settle(mesh, method.x, method.branch)
        expected = n * elongation_at(carried, k, growth, toe)
        allowed = n * math.sqrt(n) * r / ((1.0 - LOSS) * k)
        assert method.x[-1, 0] - mesh.rest[-1, 0] == pytest.approx(expected, abs=allowed)


def test_a_loop_of_equilibria_loses_the_area_between_the_branches() -> None:
    """The work at the drawn end of a bar, there and back: n links times h U(Δ) - (h T(Δ))² / (2 κ).

    The trapezoidal rule on steps s of a link errs by at most s² / 8 times the variation of its tension's tangent. On
    the way there that is κ - k; it then jumps by no more than κ to the friction's, falls from there by κ or more to the
    lower branch's and along it by no more than κ: 5 κ covers all. Residuals of 1e-9 mN on 2 mm are nothing beside it.
    """
    n, steps = 2, 300
    mesh = bar(n, LOSS)
    assert mesh.law is not None
    k, growth, toe, _, friction = (float(a[0]) for a in mesh.law)
    end, far = corner(mesh), 1.4 * toe
    method = Newton(mesh)
    reaction, place = [0.0], [0.0]
    for share in (*np.linspace(0.0, 1.0, steps + 1)[1:], *np.linspace(1.0, 0.0, steps + 1)[1:]):
        assert method.move(end, mesh.rest[end] + [n * far * share, 0.0, 0.0], tolerance_mN=1e-9).converged
        reaction.append(-float(forces(mesh, method.x, method.branch)[end[0], 0]))
        place.append(n * far * share)
        settle(mesh, method.x, method.branch)
    top = loading(far, k, growth, toe)[0]
    lost = n * (LOSS * area(far, k, growth, toe) - (LOSS * top) ** 2 / (2.0 * friction))
    allowed = n * (far / steps) ** 2 / 8.0 * 5.0 * friction
    assert lost > 1000.0 * allowed
    assert np.trapezoid(reaction, place) == pytest.approx(lost, abs=allowed)


def wandered(mesh: LinkMesh) -> tuple[Array, Branch]:
    """A deformed state of a mesh whose links have been longer, some of them, and some shorter."""
    generator = np.random.default_rng(3)
    branch = never_stretched(mesh)
    assert branch is not None
    settle(mesh, mesh.rest + generator.normal(scale=0.2, size=mesh.rest.shape), branch)
    return mesh.rest + generator.normal(scale=0.2, size=mesh.rest.shape), branch


@pytest.mark.parametrize("loss", [0.0, LOSS])
def test_forces_are_minus_the_gradient_of_the_energy(loss: float) -> None:
    """A difference quotient over ±d is a mean of the forces there, which differ from that in the middle by d times the
    largest second derivative: twice the sum of the steepest tangents at the node. Rounding: 1e-15 of energies below
    100 mN mm and of 100 links, over 2 d: 1e-6."""
    mesh, d = block(loss=loss), 1e-6
    assert mesh.law is not None
    x, branch = wandered(mesh)
    f = forces(mesh, x, branch)
    steepest = np.bincount(mesh.links.ravel(), np.repeat(steepest_tangent(mesh.law), 2))
    assert energy(mesh, x, branch) < 100.0
    for i, c in product(range(0, len(x), 5), range(3)):
        step = np.zeros_like(x)
        step[i, c] = d
        quotient = (energy(mesh, x - step, branch) - energy(mesh, x + step, branch)) / (2.0 * d)
        assert quotient == pytest.approx(f[i, c], abs=2.0 * steepest[i] * d + 1e-6)
    assert np.abs(f).max() > 1.0


@pytest.mark.parametrize("loss", [0.0, LOSS])
def test_the_hessian_is_exact(loss: float) -> None:
    """Central differences of forces at d = 1e-5: truncation d² times third derivatives (κ β² < 1e4) 1e-6, rounding
    1e-13 / d = 1e-8. No link of this state lies within 1e-5 mm of a kink, or the test would fail by mN/mm."""
    mesh, d = block(loss=loss), 1e-5
    x, branch = wandered(mesh)
    full = hessian(mesh, x, branch=branch)
    for column in range(0, x.size, 7):
        step = np.zeros(x.size)
        step[column] = d
        step = step.reshape(x.shape)
        quotient = (forces(mesh, x - step, branch) - forces(mesh, x + step, branch)).ravel() / (2.0 * d)
        assert np.abs(full[:, column] - quotient).max() < 1e-5


def softest(mesh: LinkMesh, x: Array, branch: Branch | None, moved: np.ndarray) -> float:
    """The smallest eigenvalue, mN/mm, of the stiffness of the free nodes: above zero where it is stable."""
    free = np.setdiff1d(np.flatnonzero(~mesh.fixed), moved)
    at = (3 * free[:, None] + np.arange(3)).ravel()
    return float(np.linalg.eigvalsh(hessian(mesh, x, branch=branch)[np.ix_(at, at)])[0])


def test_all_methods_find_the_same_equilibrium_and_remember_alike() -> None:
    """A node of a block is drawn off, the links settle, and it is let half the way back.

    A residual r leaves nodes within ε = r / λ of the equilibrium, λ the softest stiffness, to first order: two answers
    within 2 ε, and twice that for the second order. No link's slip differs by more than its length does, and it
    changes forces by the links' κ: on the way back the answers differ by 4 (r + S ε) / λ, S = 2 max Σ κ at a node.
    Without memory the answer is elsewhere by a thousand times that.
    """
    mesh, r = block(), 1e-11
    node = corner(mesh)
    far = np.array([1.2, 0.5, -0.4])
    there: list[Array] = []
    back: list[Array] = []
    allowed = []
    for kind in METHODS:
        method = kind(mesh)
        assert method.move(node, mesh.rest[node] + far, tolerance_mN=r).converged
        there.append(method.x.copy())
        near = 4.0 * r / softest(mesh, method.x, method.branch, node)
        settle(mesh, method.x, method.branch)
        assert method.move(node, mesh.rest[node] + 0.5 * far, tolerance_mN=r).converged
        back.append(method.x.copy())
        assert method.branch is not None
        shift = 2.0 * np.bincount(mesh.links.ravel(), np.repeat(method.branch.law.friction, 2)).max() * near
        allowed.append((near, 4.0 * (r + shift) / softest(mesh, method.x, method.branch, node)))
        assert min(allowed[-1]) > 0.0
    out, home = np.max(allowed, axis=0)
    for a, b in zip(there[1:], back[1:], strict=True):
        assert np.linalg.norm(a - there[0], axis=1).max() <= out
        assert np.linalg.norm(b - back[0], axis=1).max() <= home
    forgetful = Newton(mesh)
    assert forgetful.move(node, mesh.rest[node] + 0.5 * far, tolerance_mN=r).converged
    assert np.linalg.norm(forgetful.x - back[0], axis=1).max() > 1000.0 * home


@pytest.mark.parametrize("kind", METHODS)
def test_no_solve_moves_the_slip(kind: Kind) -> None:
    """The memory is the caller's: a movement that is tried and taken back leaves no trace."""
    mesh = block()
    node = corner(mesh)
    method = kind(mesh)
    method.move(node, mesh.rest[node] + [0.8, 0.0, 0.3], tolerance_mN=1e-6)
    assert method.branch is not None
    assert not method.branch.slip.any()
    settle(mesh, method.x, method.branch)
    assert method.branch.slip.any()


def test_without_a_law_the_kernels_compute_what_they_did() -> None:
    """Bit for bit: k (l - l0) / l times the distance, link after link, and k (1 - l0 / l) across, in this order."""
    mesh = replace(block(), law=None)
    x = mesh.rest + np.random.default_rng(0).normal(scale=0.2, size=mesh.rest.shape)
    force, total = np.zeros_like(x), 0.0
    across = np.zeros(len(mesh.links))
    for e, (i, j) in enumerate(mesh.links):
        d = [x[j, c] - x[i, c] for c in range(3)]
        k, rest, length = mesh.stiffness[e], mesh.rest_length[e], math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        total += 0.5 * k * (length - rest) * (length - rest)
        for c in range(3):
            force[i, c] += k * (length - rest) / length * d[c]
            force[j, c] -= k * (length - rest) / length * d[c]
        across[e] = k * (1.0 - rest / length)
        along = (k - across[e]) / (length * length)
        assert blocks(mesh, x)[e, 0, 0] == along * d[0] * d[0] + across[e]
    assert np.array_equal(forces(mesh, x), force)
    assert energy(mesh, x) == total


@pytest.mark.parametrize("kind", [BlockSweeps, Relaxing])
def test_a_law_that_is_constant_changes_nothing(kind: Kind) -> None:
    """Bit for bit where only tensions and energies are used: a J without growth is an ordinary spring."""
    plain = replace(block(), law=None)
    node = corner(plain)
    answers = []
    for mesh in (plain, replace(plain, law=constant(plain)), replace(plain, law=j_shaped(plain, 0.0, 0.0))):
        method = kind(mesh)
        method.move(node, mesh.rest[node] + [0.8, 0.2, 0.3], tolerance_mN=1e-6)
        answers.append(method.x)
    assert np.array_equal(answers[0], answers[1])
    assert np.array_equal(answers[0], answers[2])


def tiny() -> Array:
    """Forces, and where all methods bring a mesh of a few nodes."""
    mesh = block((1, 1, 1))
    node = corner(mesh)
    x, branch = wandered(mesh)
    out = [np.zeros_like(x)]
    add_forces(x, mesh.links, mesh.rest_length, mesh.stiffness, 0, len(mesh.links), out[0], branch)
    for kind in METHODS:
        method = kind(mesh)
        method.move(node, mesh.rest[node] + [0.5, 0.2, 0.1], tolerance_mN=1e-10)
        settle(mesh, method.x, method.branch)
        method.move(node, mesh.rest[node] + [0.2, 0.2, 0.1], tolerance_mN=1e-10)
        out.append(method.x)
    return np.array(out)


def test_without_compilation_the_same_answer(tmp_path: Path) -> None:
    """Both end at the same residual, 1e-10 mN, twice. With the softest stiffness λ = 0.47 mN/mm here and S = 85 mN/mm
    (see above) nodes agree within 4 (r + S 4 r / λ) / λ, 6e-7 mm."""
    script = (
        "import sys, numpy; sys.path[:0] = sys.argv[1:2]; import test_law_in_equilibrium as t;"
        "numpy.save(sys.argv[2], t.tiny())"
    )
    run = [sys.executable, "-c", script, str(Path(__file__).parent), str(tmp_path / "tiny.npy")]
    subprocess.run(run, check=True, env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, timeout=120)
    assert np.allclose(np.load(tmp_path / "tiny.npy"), tiny(), rtol=0.0, atol=1e-6)
