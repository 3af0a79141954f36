"""Time against error of the ways to a vessel's equilibrium, on the same work in one run.

The work: a vessel, one node of its outer wall drawn outwards. It is clamped at both ends, as in the paper, or at its
far end only, as in a task. ``tracking``: by 0.02 mm in each frame, out to 0.28 of the vessel's radius and back, as an
instrument at 100 Hz draws it. ``cold``: from rest by all of it at once, with everything that a method has to prepare.

The error is that of the solver, not of the model: the largest distance of a node to the converged answer of the same
model. That comes from neither method but from Newton's, with a sparse direct solver, along the same path.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter_ns

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import spsolve

from trainer.anatomy.vessel import build
from trainer.bench.rows import Row
from trainer.config import Sourced
from trainer.curriculum import VesselSpec
from trainer.geometry import Array
from trainer.mechanics.attachments import Anchors
from trainer.mechanics.equilibrium import Equilibrium
from trainer.mechanics.links import LinkMesh, blocks, forces, link_mesh
from trainer.mechanics.relaxation import breadth_first, relax

#: Layers and nodes around of the vessels: 312 and 1984 nodes.
MESHES = ((13, 12), (31, 32))
#: Sweeps in a frame at which the relaxation is stopped, as the paper stops it after its share of a frame.
SWEEPS = (30, 300, 1000, 3000, 10_000, 30_000)
QUICK_SWEEPS = (30, 300, 3000)
#: Residuals, mN, at which the solve with the kept factor ends; the program's own is 1e-3.
TOLERANCES_mN = (1e-1, 1e-2, 1e-3, 1e-5)
#: The relaxation ends before its last sweep at this residual, mN.
RELAXED_mN = 1e-6
#: The way of the node: so far in each frame, so many frames out.
FRAME_MM, FRAMES_OUT = 0.02, 7
#: How often each method starts cold.
COLD_STARTS = 5
#: Residual, mN, of the converged answer.
REFERENCE_mN = 1e-9
#: The kept factor draws the node by a spring, mN/mm; it gives way by less than 1e-7 radii.
SPRING = 1e8
#: What the errors are.
ERROR_OF = "solver: largest distance of a node to the converged answer of the same model, in radii of the vessel"


@dataclass(frozen=True)
class Work:
    """A vessel, the node that is drawn, its places, and where all nodes are then."""

    ends: str  # which are clamped, in words
    mesh: LinkMesh
    elimination: np.ndarray  # (e,) the nodes that are not clamped, in an order with a narrow band
    radius_mm: float  # outer
    node: int
    free: np.ndarray  # (f,) the nodes that move by themselves
    places: Array  # (k, 3) mm
    answers: Array  # (k, n, 3) mm


class PaperRelaxation:
    """Brown et al. 2001, section 3, stopped after so many sweeps in a frame."""

    name = "relaxation"

    def __init__(self, work: Work, sweeps: float) -> None:
        self.setting = f"{sweeps:g} sweeps at most"
        self.x = work.mesh.rest.copy()
        self._work, self._sweeps = work, int(sweeps)
        self._moved = np.array([work.node])

    def draw(self, place: Array) -> bool:
        """Draw the node to ``place`` (3,); whether the method says that it converged."""
        self.x[self._work.node] = place
        mesh = self._work.mesh
        return relax(mesh, self.x, self._moved, tolerance_mN=RELAXED_mN, most_sweeps=self._sweeps).converged


class KeptFactor:
    """L-BFGS over the factor of the rest state, to a residual: what the program runs at every tick."""

    name = "kept factor"

    def __init__(self, work: Work, tolerance_mN: float) -> None:
        self.setting = f"to {tolerance_mN:g} mN"
        self._tolerance_mN = tolerance_mN
        self._state = Equilibrium(work.mesh, (work.elimination,))
        self._slot = np.array([self._state.hold(np.full(3, work.node), np.array([1.0, 0.0, 0.0]))])
        self._stiffness = SPRING * np.eye(3)[None]

    @property
    def x(self) -> Array:
        return self._state.x

    def draw(self, place: Array) -> bool:
        """Draw the node to ``place`` (3,); whether the method says that it converged."""
        held = Anchors(self._slot, place[None], self._stiffness)
        return self._state.solve(held, tolerance_mN=self._tolerance_mN).converged


Method = PaperRelaxation | KeptFactor
Candidate = tuple[type[PaperRelaxation] | type[KeptFactor], float]


def candidates(quick: bool) -> list[Candidate]:
    """The methods with their settings; ``quick`` leaves out the longest relaxations."""
    sweeps = QUICK_SWEEPS if quick else SWEEPS
    return [*((PaperRelaxation, s) for s in sweeps), *((KeptFactor, t) for t in TOLERANCES_mN)]


def prepare(layers: int, around: int, both_ends: bool) -> Work:
    """The work on a vessel with the size and the stiffness of those in the task single-stitch.

    With ``both_ends`` the cut edge is clamped, too.
    """
    given = Sourced(500.0, "assumed: as in the task single-stitch")
    spec = VesselSpec(
        name="A", cut_edge_mm=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), outer_diameter_mm=1.0, wall_mm=0.15,
        length_mm=2.0, layers=layers, around=around, modulus_kPa=given, puncture_outer_mN=given,
        puncture_inner_mN=given, tear_mN=given,
    )  # fmt: skip
    vessel = build(spec)
    mesh, order, node = vessel.mesh, vessel.elimination, vessel.node(layers // 2, 0)
    if both_ends:
        # The cut's nodes go to the end of the numbering: the kept factor asks that a body begins with a free node.
        cut = 2 * around
        fixed = np.roll(mesh.fixed | (vessel.axial_mm == 0.0), -cut)
        links = (mesh.links - cut) % len(mesh.rest)
        mesh = link_mesh(np.roll(mesh.rest, -cut, axis=0), links, mesh.stiffness, fixed)
        order, node = (order[order >= cut] - cut).astype(np.int32), node - cut
    free = np.setdiff1d(np.flatnonzero(~mesh.fixed), [node])
    places = mesh.rest[node] + FRAME_MM * np.arange(FRAMES_OUT + 1)[:, None] * vessel.twelve
    answers, x = [], mesh.rest.copy()
    for place in places:
        x[node] = place
        converge(mesh, x, free)
        answers.append(x.copy())
    ends = "both ends clamped" if both_ends else "cut free"
    return Work(ends, mesh, order, vessel.outer_radius_mm, node, free, places, np.array(answers))


def converge(mesh: LinkMesh, x: Array, free: np.ndarray, most_steps: int = 30) -> None:
    """Newton's method on the nodes ``free`` (f,) of ``x`` (n, 3), in place, to a residual of REFERENCE_mN.

    Raises ArithmeticError when it does not get there: then there is nothing to compare with.
    """
    coordinates = (3 * free[:, None] + np.arange(3)).ravel()
    for _ in range(most_steps):
        force = forces(mesh, x)[free].ravel()
        if np.linalg.norm(force) <= REFERENCE_mN:
            return
        stiffness = _hessian(mesh, x)[coordinates][:, coordinates]
        x[free] += spsolve(stiffness, force).reshape(-1, 3)
    raise ArithmeticError(f"Newton's method did not converge in {most_steps} steps")


def _hessian(mesh: LinkMesh, x: Array) -> csc_matrix:
    """The energy's second derivatives (3 n, 3 n) mN/mm, sparse, fixed nodes included."""
    i, j = mesh.links.T.astype(np.int64)
    block = blocks(mesh, x)
    row = 3 * np.concatenate([i, j, i, j])[:, None, None] + np.arange(3)[:, None]
    column = 3 * np.concatenate([i, j, j, i])[:, None, None] + np.arange(3)
    row, column = np.broadcast_arrays(row, column)
    values = np.concatenate([block, block, -block, -block])
    return csc_matrix((values.ravel(), (row.ravel(), column.ravel())), shape=(x.size, x.size))


class Tally:
    """What the frames of one method with one setting came to."""

    def __init__(self, case: str, work: Work, method: Method) -> None:
        self.case, self.work = f"{case}, {work.ends}", work
        self.method, self.setting = method.name, method.setting
        self.ms: list[float] = []
        self.error = self.residual = 0.0
        self.converged = 0

    def add(self, x: Array, at: int, ns: int, converged: bool) -> None:
        """A frame of ``ns`` nanoseconds that left the nodes at ``x`` (n, 3), with the node at place ``at``."""
        work = self.work
        self.ms.append(ns * 1e-6)
        far = float(np.max(np.linalg.norm(x - work.answers[at], axis=1)))
        self.error = max(self.error, far / work.radius_mm)
        self.residual = max(self.residual, float(np.linalg.norm(forces(work.mesh, x)[work.free])))
        self.converged += converged

    def row(self) -> Row:
        frames = len(self.ms)
        ended = "converged" if self.converged == frames else f"stopped in {frames - self.converged} of {frames} frames"
        median, p90 = (float(v) for v in np.percentile(self.ms, (50, 90)))
        return Row(
            self.case, len(self.work.mesh.rest), self.method, self.setting, frames, median, p90, self.error, ERROR_OF,
            self.residual, ended,
        )  # fmt: skip


def track(work: Work, chosen: list[Candidate]) -> list[Row]:
    """All methods follow the same path, frame by frame in turn, so that a noisy machine is noisy for all of them."""
    methods = [kind(work, setting) for kind, setting in chosen]
    tallies = [Tally("tracking", work, m) for m in methods]
    out = list(range(1, FRAMES_OUT + 1))
    turns = list(zip(methods, tallies, strict=True))
    for at in out + [k - 1 for k in reversed(out)]:
        turns = turns[1:] + turns[:1]  # who comes after a method with large arrays finds its own displaced
        for method, tally in turns:
            begun = perf_counter_ns()
            converged = method.draw(work.places[at])
            tally.add(method.x, at, perf_counter_ns() - begun, converged)
    return [t.row() for t in tallies]


def start_cold(work: Work, chosen: list[Candidate], starts: int) -> list[Row]:
    """All methods in turn, from nothing but the mesh to the last place; the time holds what they prepare."""
    tallies: dict[Candidate, Tally] = {}
    for _ in range(starts):
        for candidate in chosen:
            kind, setting = candidate
            begun = perf_counter_ns()
            method = kind(work, setting)
            converged = method.draw(work.places[-1])
            ns = perf_counter_ns() - begun
            tallies.setdefault(candidate, Tally("cold", work, method)).add(method.x, FRAMES_OUT, ns, converged)
    return [t.row() for t in tallies.values()]


def order_ms(work: Work) -> float:
    """What the relaxation spends in a frame on the order of its nodes, ms; it is not compiled."""
    begun = perf_counter_ns()
    breadth_first(work.mesh, np.array([work.node]))
    return (perf_counter_ns() - begun) * 1e-6


def measure(quick: bool, meshes: tuple[tuple[int, int], ...] = MESHES) -> tuple[list[Row], dict[int, float]]:
    """All rows, and for each size what the relaxation spends on its order, ms. Kernels are compiled before."""
    chosen = candidates(quick)
    track(prepare(5, 8, both_ends=True), [(PaperRelaxation, 30.0), (KeptFactor, 1e-3)])
    tracked: list[Row] = []
    cold: list[Row] = []
    order: dict[int, float] = {}
    for both_ends in (True, False):
        for layers, around in meshes:
            work = prepare(layers, around, both_ends)
            tracked += track(work, chosen)
            cold += start_cold(work, chosen, COLD_STARTS)
            order[len(work.mesh.rest)] = order_ms(work)
    return tracked + cold, order
