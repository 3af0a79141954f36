"""Hard cases of static equilibrium for every method: each ends right, or says that it did not.

The law of all of them: the state is finite; a method that says it converged is in equilibrium (the residual is measured
here again), has no more energy than where the instrument put it, and is on the branch to which small steps lead where
the way there matters. Every jump is followed in sub-steps, as ``mechanics.path_following`` chooses them, to 1e-4 mN.

*Kept factor* so has up to 300 iterations a sub-step and holds of 1e6 mN/mm: it is what the method can do. *As in the
scene* is what a session does of it: the jump is one tick, divided into movements as ``scene`` does it, each with the
few iterations, the tolerance and a jaw's holds of ``interactions.holding`` (0.01 mN, 7500 mN/mm); then the instrument
rests for a second. It answers when a tick says that it converged, and how long that took is told; until then the scene
judges nothing by its forces.

Thresholds: the residual may be ten times the tolerance, since methods measure it while they sweep, or at other nodes'
places; on the right branch the answer is nearer than 0.01 R, other branches being 0.2 R and more away; held nodes are
off by what they pull with over the hold's stiffness, and what is drawn with them as far.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from trainer.bench.equilibria import residual_mN
from trainer.bench.vessel import Work, prepare
from trainer.geometry import Array
from trainer.interactions.holding import HOLD, MOST_ITERATIONS, TOLERANCE_MN
from trainer.mechanics.attachments import Anchors
from trainer.mechanics.equilibrium import Equilibrium
from trainer.mechanics.krylov import NewtonKrylov
from trainer.mechanics.links import LinkMesh, energy, forces, link_mesh
from trainer.mechanics.newton import Newton, Outcome
from trainer.mechanics.path_following import Follower, follow
from trainer.mechanics.relaxation import relax
from trainer.mechanics.sweeps import BlockSweeps
from trainer.scene import MOST_MOVEMENTS, STRIDE_MM

#: Residual, mN, at which a method may say that it converged; the scene's own is 1e-2.
TOLERANCE_mN = 1e-4
#: … and by how much its own measure may differ from ours: the relaxation measures while it sweeps.
MEASURED = 10.0
#: An answer on the right branch is nearer than this, radii; other branches are 0.2 and more away (facts of the cases).
BRANCH = 1e-2
#: The kept factor draws nodes by springs, mN/mm, which give way by what the links pull there.
SPRING = 1e6
#: A jaw's hold of the vessel of these cases (``bench/vessel.py``: 500 kPa, 0.15 mm), mN/mm; see ``holding.grips``.
SCENE_SPRING = HOLD * 500.0 * 0.15
#: A second of rest after a jump, ticks.
RESTS = 100
#: Sub-steps of the reference for a way of one radius.
FINE = 200


class Relaxation:
    """The paper's relaxation as a method that follows a way."""

    def __init__(self, mesh: LinkMesh) -> None:
        self.mesh, self.x = mesh, mesh.rest.copy()

    def move(self, nodes: np.ndarray, places: Array, *, tolerance_mN: float, load: Array | None = None) -> Outcome:
        self.x[nodes] = places
        ended = relax(self.mesh, self.x, nodes, tolerance_mN=tolerance_mN, most_sweeps=20_000, load=load)
        return Outcome(ended.converged, ended.sweeps, ended.residual_mN, energy(self.mesh, self.x))


class KeptFactor:
    """The method of the scene, which draws nodes by springs; as ``path_following`` leads it, until it has converged."""

    spring, most_iterations = SPRING, 300

    def __init__(self, mesh: LinkMesh) -> None:
        free = np.flatnonzero(~mesh.fixed).astype(np.int32)
        self.mesh = mesh
        self._state = Equilibrium(mesh, (free[reverse_cuthill_mckee(_adjacency(mesh)[free][:, free])],))
        self._slots: dict[int, int] = {}

    @property
    def x(self) -> Array:
        return self._state.x

    def move(self, nodes: np.ndarray, places: Array, *, tolerance_mN: float, load: Array | None = None) -> Outcome:
        for node in nodes.tolist():
            if node not in self._slots:
                self._slots[node] = self._state.hold(np.full(3, node), np.array([1.0, 0.0, 0.0]))
        slots = np.array([self._slots[node] for node in nodes.tolist()])
        held = Anchors(slots, places, np.repeat(self.spring * np.eye(3)[None], len(nodes), axis=0))
        ended = self._state.solve(held, tolerance_mN=tolerance_mN, max_iterations=self.most_iterations)
        return Outcome(ended.converged, ended.iterations, ended.residual_mN, energy(self.mesh, self.x))


class AsInScene(KeptFactor):
    """The same with the scene's holds and iterations; see ``through_ticks``."""

    spring, most_iterations = SCENE_SPRING, MOST_ITERATIONS


def _adjacency(mesh: LinkMesh) -> csr_matrix:
    i, j = mesh.links.T
    pairs = (np.concatenate([i, j]), np.concatenate([j, i]))
    return csr_matrix((np.ones(2 * len(i)), pairs), shape=(len(mesh.rest), len(mesh.rest)))


SCENE = "kept factor, as in the scene"
#: Each as it is followed along a jump: the scene's in its movements, all others as mechanics.path_following does.
METHODS: dict[str, Callable[[LinkMesh], Follower]] = {
    "relaxation": Relaxation,
    "block sweeps": BlockSweeps,
    "kept factor": KeptFactor,
    SCENE: AsInScene,
    "Newton, SuperLU": Newton,
    "Newton–Krylov": NewtonKrylov,
}


@dataclass(frozen=True)
class HardCase:
    """A mesh, nodes of it, and the places to which they are taken in turn, each in one jump."""

    mesh: LinkMesh
    nodes: np.ndarray
    ways: list[Array]
    radius_mm: float
    same_branch: bool = False  # compare with small steps


@cache
def _vessel() -> Work:
    return prepare(13, 12, both_ends=False, frames=1)


def _patch(work: Work) -> np.ndarray:
    """The outer nodes within 0.3 mm of the one that is drawn."""
    rest = work.mesh.rest
    outer = np.hypot(rest[:, 1], rest[:, 2]) > 0.95 * work.radius_mm
    return np.flatnonzero(outer & (np.linalg.norm(rest - rest[work.node], axis=1) < 0.3) & ~work.mesh.fixed)


def _pushed(*depths: float) -> HardCase:
    """The patch is pushed inwards by so many radii, in one jump each."""
    work = _vessel()
    nodes, rest = _patch(work), work.mesh.rest
    inwards = rest[work.node] * [0.0, -1.0, -1.0] / work.radius_mm
    ways = [rest[nodes] + depth * work.radius_mm * inwards for depth in depths]
    return HardCase(work.mesh, nodes, ways, work.radius_mm, same_branch=True)


def _stiffness_ratio() -> HardCase:
    """Every other link is a million times as stiff."""
    work = _vessel()
    factor = np.where(np.arange(len(work.mesh.links)) % 2 == 0, 1.0, 1e-6)
    mesh = replace(work.mesh, stiffness=work.mesh.stiffness * factor)
    return HardCase(mesh, np.array([work.node]), [work.places[-1][None]], work.radius_mm)


def _pulled(radii: float) -> HardCase:
    work = _vessel()
    outwards = work.mesh.rest[work.node] * [0.0, 1.0, 1.0]
    place = work.mesh.rest[work.node] + radii * outwards
    return HardCase(work.mesh, np.array([work.node]), [place[None]], work.radius_mm)


def _flattened() -> HardCase:
    """A node is put onto its neighbour: a link of no length, and links that fall onto each other."""
    work = _vessel()
    mesh, node = work.mesh, work.node
    beside = int(mesh.neighbour[mesh.start[node]])
    return HardCase(mesh, np.array([node]), [mesh.rest[beside][None]], work.radius_mm)


def _not_finite() -> HardCase:
    work = _vessel()
    nowhere = np.array([[np.nan, 0.0, np.inf]])
    return HardCase(work.mesh, np.array([work.node]), [nowhere], work.radius_mm)


def _isolated() -> HardCase:
    """A node without a link among the free ones."""
    work = _vessel()
    mesh = work.mesh
    lonely = link_mesh(
        np.concatenate([mesh.rest[:1] + 5.0, mesh.rest]), mesh.links + 1, mesh.stiffness,
        np.concatenate([[False], mesh.fixed]),
    )  # fmt: skip
    return HardCase(lonely, np.array([work.node + 1]), [work.places[-1][None]], work.radius_mm)


def _collinear() -> HardCase:
    """A chain of links in one line, free of force: nothing holds it across until it is drawn."""
    x = np.zeros((12, 3))
    x[:, 0] = np.arange(12.0)
    links = np.stack([np.arange(11), np.arange(1, 12)], axis=1)
    mesh = link_mesh(x, links, np.ones(11), np.arange(12) == 11)
    ways = [np.array([[-1.0, 0.0, 0.0]]), np.array([[-1.0, 0.5, 0.0]])]
    return HardCase(mesh, np.array([0]), ways, 1.0)


CASES: dict[str, Callable[[], HardCase]] = {
    "stiffness ratio of 1e6": _stiffness_ratio,
    "link of no length": _flattened,
    "collinear links": _collinear,
    "node pulled by 3 R": lambda: _pulled(3.0),
    "patch pushed in by 0.5 R in one jump": lambda: _pushed(0.5),
    "patch pushed in by 0.8 R in one jump": lambda: _pushed(0.8),
    "patch pushed in by 1.2 R in one jump": lambda: _pushed(1.2),
    "collapsed vessel pulled open again": lambda: _pushed(1.2, 0.0),
    "isolated node": _isolated,
    "place that is no number": _not_finite,
}


@cache
def _reference(case: str) -> Array:
    """Where small steps lead, each solved by Newton–Krylov."""
    hard = CASES[case]()
    method = NewtonKrylov(hard.mesh)
    for places in hard.ways:
        start = method.x[hard.nodes].copy()
        longest = float(np.max(np.linalg.norm(places - start, axis=1)))
        steps = int(np.ceil(FINE * longest / hard.radius_mm))
        for k in range(1, steps + 1):
            method.move(hard.nodes, start + (places - start) * (k / steps), tolerance_mN=0.01 * TOLERANCE_mN)
    return method.x


def through_ticks(method: AsInScene, nodes: np.ndarray, places: Array) -> int:
    """A jump in one tick, in the scene's movements, and ticks at rest until one converges: how many, or -1."""
    start = method.x[nodes].copy()
    longest = float(np.max(np.linalg.norm(places - start, axis=1)))
    movements = min(MOST_MOVEMENTS, max(1, math.ceil(longest / STRIDE_MM))) if math.isfinite(longest) else 1
    for m in range(1, movements + 1):
        ended = method.move(nodes, start + (places - start) * (m / movements), tolerance_mN=TOLERANCE_MN)
    for tick in range(RESTS + 1):
        if ended.converged:
            return tick
        ended = method.move(nodes, places, tolerance_mN=TOLERANCE_MN)
    return -1


def _gone(follower: Follower, hard: HardCase) -> tuple[str, str]:
    """Takes the nodes along all ways: in words how that went, and how it did not."""
    waited = []
    for places in hard.ways:
        if isinstance(follower, AsInScene):
            ticks = through_ticks(follower, hard.nodes, places)
            if ticks < 0:
                return "", f"nor {RESTS} ticks after a jump"
            waited.append(ticks)
        else:
            path = follow(follower, hard.nodes, places, tolerance_mN=TOLERANCE_mN)
            if not path.converged:
                return "", f"stays at {path.share:.0%} of a way"
    return (f", {max(waited)} ticks after the jump" if waited else ""), ""


def outcome(case: str, method: str) -> str:
    """What the method did. Raises AssertionError when it broke the law: NaN, a leap, a silent wrong answer."""
    hard = CASES[case]()
    in_scene = method == SCENE
    tolerance, spring = (TOLERANCE_MN, SCENE_SPRING) if in_scene else (TOLERANCE_mN, SPRING)
    try:
        follower = METHODS[method](hard.mesh)
        words, stopped = _gone(follower, hard)
    except ValueError as refusal:
        return f"refused: {refusal}"
    x = follower.x
    assert np.isfinite(x).all(), "a position is not finite"
    size = float(np.max(np.abs(hard.mesh.rest))) + float(np.max([np.abs(w) for w in hard.ways]))
    assert np.max(np.abs(x)) <= 2.0 * size, "a node has flown off"
    free = np.setdiff1d(np.flatnonzero(~hard.mesh.fixed), hard.nodes)
    left = residual_mN(hard.mesh, x, free)
    if stopped:
        return f"not converged: {stopped}, residual there {left:.1e} mN"
    off = np.linalg.norm(x[hard.nodes] - hard.ways[-1], axis=1)
    give = (np.linalg.norm(forces(hard.mesh, x)[hard.nodes], axis=1) + MEASURED * tolerance) / spring
    assert (off <= give).all(), f"a node is {np.max(off):.1e} mm from where it was taken"
    assert left <= MEASURED * tolerance, f"residual {left:.1e} mN, and it says that it converged"
    moved = hard.mesh.rest.copy()
    moved[hard.nodes] = hard.ways[-1]
    assert len(hard.ways) > 1 or energy(hard.mesh, x) <= energy(hard.mesh, moved), (
        "more energy than with nothing solved"
    )
    if not hard.same_branch:
        return f"ok: residual {left:.1e} mN{words}"
    error = float(np.max(np.linalg.norm(x - _reference(case), axis=1))) / hard.radius_mm
    allowed = BRANCH + float(np.max(give)) / hard.radius_mm
    assert error <= allowed, f"another branch, {error:.2f} R away, and it says that it converged"
    return f"ok: {error:.1e} R from small steps{words}"


def cases() -> list[tuple[str, str, Callable[[], str]]]:
    """Case, method, and a function that tells the outcome."""
    return [(case, method, partial(outcome, case, method)) for case in CASES for method in METHODS]
