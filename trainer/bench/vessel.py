"""Time against error of the ways to a vessel's static equilibrium, on the same work in one run.

The work: a vessel, one node of its outer wall drawn outwards. It is clamped at both ends, as in the paper, or at its
far end only, as in a task (cut free). ``tracking``: by 0.02 mm in each frame, out and back, as an instrument at 100 Hz
draws it. ``cold``: from rest by all of it at once, with everything that a method has to prepare. The way is 0.28 of the
radius; 0.2 at 20 000 nodes and 0.04, in frames of 0.01 mm, at 200 000, because a node that is drawn by more of its
mesh's ever smaller cells wrinkles the wall around it, and then there are several answers.

The error is the solver's, not the model's: the largest distance of a node to the converged answer of the same model.
Whose that is, the rows say, and why, ``equilibria``: code of the bench's own for the small meshes, Newton's method with
SuperLU at 20 000 nodes, whose own row is then no check of it, and at 200 000 Newton–Krylov along another way: there the
error says how far an answer depends on the way and on the tolerance, no more. The residual is relative to that of the
first frame, in which only the drawn node has moved.

The paper's relaxation is here as published, with a step that needs no trial, and with the largest step by trial. The
trial, of some thousand sweeps, is not in its time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter

import numpy as np

from trainer.anatomy.vessel import build
from trainer.bench.equilibria import answers, residual_mN
from trainer.bench.rows import Row, left_out, median_and_p90, worst
from trainer.bench.stream import stream_ms
from trainer.config import Sourced
from trainer.curriculum import VesselSpec
from trainer.geometry import Array
from trainer.mechanics.attachments import Anchors
from trainer.mechanics.equilibrium import Equilibrium
from trainer.mechanics.krylov import NewtonKrylov
from trainer.mechanics.links import LinkMesh, link_mesh
from trainer.mechanics.newton import Newton
from trainer.mechanics.relaxation import factor_by_trial, relax
from trainer.mechanics.sweeps import BlockSweeps

#: The way of the node in a frame.
FRAME_MM = 0.02
#: Residuals at which a solve ends, as a share of the first frame's.
SHARES = (1e-2, 1e-3, 1e-6)
#: … and at which a task's solves end, mN; a scene's tissue runs on the kept factor.
TASK_mN = 0.01
#: The relaxation's step is found by trials of at most so many sweeps, to this share of the residual at first.
TRIAL_SWEEPS, TRIAL_SHARE = 10_000, 1e-2
#: The kept factor draws the node by a spring, mN/mm; it gives way by less than 1e-7 radii.
SPRING = 1e8
#: How often each method starts cold at most.
COLD_STARTS = 5
#: A method takes part in a case as long as it has used less than this, s; at least one frame.
SECONDS, QUICK_SECONDS = 6.0, 0.5
#: The error at which methods are compared.
COMPARED_AT = 1e-4
#: What the errors are.
ERROR_OF = "solver: largest distance of a node to the converged answer of {}, in radii of the vessel"
NO_ERROR = "nothing: not measured"
LIMIT_OF = "memory limit: none; an array of the bytes held is scaled in place until as many are moved"
RESIDUAL_OF = "share of the first frame's Euclidean norm of the forces on the free nodes"


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
    answered_by: str
    first_mN: float  # residual when the node is at the first place and all others at rest
    all_mN: float  # … when it is at the last place

    @cached_property
    def relaxation_factor(self) -> float:
        """The paper's step for this mesh, found by trial on all of the way at once, the hardest work."""
        x = _with(self.mesh.rest, self.node, self.places[-1])
        return factor_by_trial(
            self.mesh, x, np.array([self.node]), tolerance_mN=TRIAL_SHARE * self.all_mN, most_sweeps=TRIAL_SWEEPS
        )


class Moved:
    """A method with ``move``, as in newton, krylov and sweeps."""

    def __init__(self, work: Work, kind: type[Newton] | type[NewtonKrylov] | type[BlockSweeps]) -> None:
        self._method = kind(work.mesh)
        self._node = np.array([work.node])

    @property
    def x(self) -> Array:
        return self._method.x

    @property
    def memory(self) -> tuple[int, int]:
        """Bytes that are held, and that were read so far, at least; 0 where nobody counts."""
        method = self._method
        return (method.held_bytes, method.moved_bytes) if isinstance(method, NewtonKrylov) else (0, 0)

    def draw(self, place: Array, tolerance_mN: float, seconds: float) -> bool:
        """Draw the node to ``place`` (3,); whether the method says that it converged."""
        return self._method.move(self._node, place[None], tolerance_mN=tolerance_mN).converged


class PaperRelaxation:
    """Brown et al. 2001, section 3: stopped after its time, as in the paper."""

    memory = (0, 0)

    def __init__(self, work: Work, factor: float) -> None:
        self.x = work.mesh.rest.copy()
        self._work, self._factor = work, factor

    def draw(self, place: Array, tolerance_mN: float, seconds: float) -> bool:
        self.x[self._work.node] = place
        end = perf_counter() + seconds
        return relax(
            self._work.mesh, self.x, np.array([self._work.node]), tolerance_mN=tolerance_mN, most_sweeps=1_000_000,
            out_of_time=lambda: perf_counter() > end, factor=self._factor,
        ).converged  # fmt: skip


class KeptFactor:
    """L-BFGS over the factor of the rest state, to its end; a scene runs it with fewer iterations and softer holds."""

    memory = (0, 0)

    def __init__(self, work: Work) -> None:
        self._state = Equilibrium(work.mesh, (work.elimination,))
        self._slot = np.array([self._state.hold(np.full(3, work.node), np.array([1.0, 0.0, 0.0]))])
        self._stiffness = SPRING * np.eye(3)[None]

    @property
    def x(self) -> Array:
        return self._state.x

    def draw(self, place: Array, tolerance_mN: float, seconds: float) -> bool:
        held = Anchors(self._slot, place[None], self._stiffness)
        return self._state.solve(held, tolerance_mN=tolerance_mN).converged


Method = Moved | PaperRelaxation | KeptFactor
BY_TRIAL = "relaxation, step by trial"
METHODS: dict[str, Callable[[Work], Method]] = {
    "relaxation": lambda work: PaperRelaxation(work, 1.0),
    BY_TRIAL: lambda work: PaperRelaxation(work, work.relaxation_factor),
    "block sweeps": lambda work: Moved(work, BlockSweeps),
    "kept factor": KeptFactor,
    "Newton, SuperLU": lambda work: Moved(work, Newton),
    "Newton–Krylov": lambda work: Moved(work, NewtonKrylov),
}
Candidate = tuple[str, float]


@dataclass(frozen=True)
class Case:
    """A mesh, how far its node is drawn, and who takes part."""

    layers: int
    around: int
    both_ends: bool
    frames: int
    candidates: tuple[Candidate, ...]
    left_out: tuple[tuple[str, str], ...] = ()  # method and reason
    cold: bool = True
    frame_mm: float = FRAME_MM
    seconds: float = SECONDS


def cases(quick: bool) -> list[Case]:
    """What is measured; ``quick`` leaves out what takes long, and says so."""
    every = tuple((name, share) for name in METHODS for share in SHARES)
    if quick:
        left_out = tuple((name, "skipped: not in --quick") for name in METHODS)
        others = tuple(o for o in left_out if o[0] != "kept factor")
        few = tuple(c for c in every if c[1] == 1e-3)
        return [
            Case(13, 12, True, 7, few), Case(31, 32, True, 7, few),
            Case(31, 32, False, 7, (("kept factor", 1e-3),), others, cold=False),
            Case(101, 100, True, 1, (("Newton–Krylov", 1e-3),), left_out[:-1], cold=False),
            Case(317, 316, True, 1, (), left_out),
        ]  # fmt: skip
    small = [Case(*mesh, both, 7, every) for both in (True, False) for mesh in ((13, 12), (31, 32))]
    slow = tuple((name, "skipped: minutes for a frame") for name in ("relaxation", BY_TRIAL, "block sweeps"))
    big = tuple((name, 1e-3) for name in ("kept factor", "Newton, SuperLU", "Newton–Krylov"))
    too_big = (("kept factor", "skipped: 14 GB of band"), ("Newton, SuperLU", "skipped: minutes for a factor"))
    return [
        *small,
        Case(101, 100, True, 5, (*big, ("Newton–Krylov", 1e-6)), slow),
        Case(317, 316, True, 2, (("Newton–Krylov", 1e-6),), (*slow, *too_big), frame_mm=0.5 * FRAME_MM, seconds=30.0),
    ]


def prepare(
    layers: int, around: int, both_ends: bool, frames: int = 7, frame_mm: float = FRAME_MM, quick: bool = False
) -> Work:
    """The work on a vessel with the size and the stiffness of those in the task single-stitch.

    With ``both_ends`` the cut edge is clamped, too. ``quick``: as ``answers`` takes it. Raises ArithmeticError where no
    answer is found to compare with.
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
    places = mesh.rest[node] + frame_mm * np.arange(frames + 1)[:, None] * vessel.twelve
    first_mN, all_mN = (residual_mN(mesh, _with(mesh.rest, node, places[k]), free) for k in (1, -1))
    found, answered_by = answers(mesh, node, places, free, first_mN, quick)
    ends = "both ends clamped" if both_ends else "cut free"
    return Work(
        ends, mesh, order, vessel.outer_radius_mm, node, free, places, found, answered_by, first_mN, all_mN
    )  # fmt: skip


def _with(x: Array, node: int, place: Array) -> Array:
    out = x.copy()
    out[node] = place
    return out


class Tally:
    """What the frames of one method with one setting came to."""

    def __init__(self, case: str, work: Work, name: str, share: float) -> None:
        self.case, self.work, self.name = f"{case}, {work.ends}", work, name
        self.of_mN = work.first_mN if case == "tracking" else work.all_mN
        self.tolerance_mN = share * self.of_mN
        self.setting = f"to {share:.2g} ({self.tolerance_mN:.2g} mN)"
        if name == BY_TRIAL:
            self.setting += f", α = {work.relaxation_factor:g} / Σ k"
        self.ms: list[float] = []
        self.held = 0  # bytes
        self.moved: list[float] = []  # bytes in each frame
        self.error = self.residual = 0.0
        self.converged = 0

    def draw(self, method: Method, at: int, begun: float, seconds: float) -> None:
        """A frame of ``method`` that began at ``begun`` s of the clock, and takes the node to place ``at``."""
        work = self.work
        before = method.memory[1]
        self.converged += method.draw(work.places[at], self.tolerance_mN, seconds)
        self.ms.append((perf_counter() - begun) * 1e3)
        self.held, after = method.memory
        self.moved.append(after - before)
        far = float(np.max(np.linalg.norm(method.x - work.answers[at], axis=1)))
        self.error = worst(self.error, far / work.radius_mm)
        self.residual = worst(self.residual, residual_mN(work.mesh, method.x, work.free) / self.of_mN)

    def rows(self) -> list[Row]:
        """The method's row, and that of the memory limit where it counts what it reads and writes."""
        frames = len(self.ms)
        ended = "converged" if self.converged == frames else f"stopped in {frames - self.converged} of {frames} frames"
        median, p90 = median_and_p90(self.ms)
        work, size = self.work, len(self.work.mesh.rest)
        rows = [
            Row(
                self.case, size, self.name, self.setting, frames, median, p90, self.error,
                ERROR_OF.format(work.answered_by), self.residual,
                ended, RESIDUAL_OF, COMPARED_AT,
            )
        ]  # fmt: skip
        moved = float(np.median(self.moved))
        if moved > 0.0:
            limit = stream_ms(moved, self.held)
            bytes_of = f"{moved / 1e6:.3g} MB of {self.held / 1e6:.3g} MB held"
            status = f"{100.0 * limit / median:.0f} % of the method's time"
            name = f"memory limit of {self.name}"
            nan = math.nan
            rows.append(Row(self.case, size, name, bytes_of, frames, limit, nan, nan, LIMIT_OF, nan, status))
        return rows


def track(work: Work, candidates: tuple[Candidate, ...], seconds: float) -> list[Row]:
    """All methods follow the same path, frame by frame in turn, so that a noisy machine is noisy for all of them."""
    turns = [(METHODS[name](work), Tally("tracking", work, name, share)) for name, share in candidates]
    tallies = [tally for _, tally in turns]
    out = list(range(1, len(work.places)))
    for at in out + [k - 1 for k in reversed(out)]:
        turns = turns[1:] + turns[:1]  # who comes after a method with large arrays finds its own displaced
        for method, tally in turns:
            if sum(tally.ms) < 1e3 * seconds:
                tally.draw(method, at, perf_counter(), seconds)
    return [row for t in tallies for row in t.rows()]


def start_cold(work: Work, candidates: tuple[Candidate, ...], seconds: float, starts: int = COLD_STARTS) -> list[Row]:
    """All methods in turn, from nothing but the mesh to the last place; the time holds what they prepare."""
    tallies = {c: Tally("cold", work, *c) for c in candidates}
    for _ in range(starts):
        for candidate, tally in tallies.items():
            if sum(tally.ms) < 1e3 * seconds:
                begun = perf_counter()
                tally.draw(METHODS[candidate[0]](work), len(work.places) - 1, begun, seconds)
    return [row for t in tallies.values() for row in t.rows()]


def measure(quick: bool, chosen: list[Case] | None = None) -> list[Row]:
    """All rows, tracking first. Kernels are compiled before anything is timed."""
    first = prepare(5, 8, both_ends=True)
    track(first, tuple((name, 1e-3) for name in METHODS), math.inf)
    tracked: list[Row] = []
    cold: list[Row] = []
    for case in cases(quick) if chosen is None else chosen:
        size = 2 * case.layers * case.around
        ends = "both ends clamped" if case.both_ends else "cut free"
        for name, reason in case.left_out:
            tracked.append(_left_out(f"tracking, {ends}", size, name, reason))
            cold.append(_left_out(f"cold, {ends}", size, name, reason))
        if case.candidates:
            work = prepare(case.layers, case.around, case.both_ends, case.frames, case.frame_mm, quick)
            seconds = QUICK_SECONDS if quick else case.seconds
            as_in_a_task = () if case.both_ends else (("kept factor", TASK_mN / work.first_mN),)
            tracked += track(work, (*case.candidates, *as_in_a_task), seconds)
            cold += start_cold(work, case.candidates, seconds) if case.cold else []
    return tracked + cold


def _left_out(case: str, size: int, name: str, reason: str) -> Row:
    return left_out(case, size, name, reason, NO_ERROR, RESIDUAL_OF)
