"""Time against error of the ways to integrate a mesh in time, on the same work in one run.

The work: a vessel, clamped at its far end, is plucked: its cut edge, drawn aside until all is in balance, is let go and
swings in frames of 10 ms; its nodes have a drag c = α m. One is as stiff as those in the tasks and swings at a
kilohertz, so that a frame holds several periods; one is softer 500 times, and a frame is half a period.

The error is that of the solver, not of the model: the largest distance of a node, at the end of a frame, to where RK4
takes it at half the finest step here. A method whose stable step would take too many evaluations in a frame is left
out: forward Euler with the stiff vessel, whose step is a few nanoseconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import perf_counter_ns

import numpy as np

from trainer.anatomy.vessel import Vessel, build
from trainer.bench.rows import Row, median_and_p90, worst
from trainer.config import Sourced
from trainer.curriculum import VesselSpec
from trainer.geometry import Array
from trainer.mechanics.dynamics import Model, State, at_rest, masses_of_links, model
from trainer.mechanics.implicit_euler import BackwardEuler
from trainer.mechanics.integrators import METHODS, RK4, Explicit, Method

#: Layers and nodes around of the vessels: 312 and 1984 nodes.
MESHES = ((13, 12), (31, 32))
#: Young's moduli, kPa: of the tasks' vessels, and a soft one.
MODULI_kPa = {"stiff": 500.0, "soft": 1.0}
#: Density of soft tissue, kg/mm³, and drag over mass, 1/s: both assumed.
DENSITY, DAMPING = 1.06e-6, 200.0
#: A link's dashpot over its stiffness, s √kPa, times the root of Young's modulus: the fastest modes, which no frame can
#: show, die within some periods; assumed.
VISCOSITY = 2e-5
#: How far the cut edge is drawn aside, in radii of the vessel; by how many steps of so many seconds.
PLUCKED, DRAWING_STEPS, DRAWING_STEP_S = 0.3, 10, 1.0
FRAME_S, FRAMES = 0.01, 5
#: Steps of the explicit methods, in parts of the stable one, and of backward Euler, in parts of a frame.
PARTS = (1, 2)
QUICK_PARTS = (1,)
STEPS_A_FRAME = (1, 10, 100, 1000)
QUICK_STEPS_A_FRAME = (1, 10, 100)
#: RK4's steps for the reference are so many times finer than its finest here: an error 16 times smaller.
REFERENCE_FINER = 2
#: Evaluations of all forces in a frame, beyond which a method is left out.
MOST_EVALUATIONS, QUICK_MOST_EVALUATIONS = 100_000, 40_000
#: Residual at which Newton's method ends, over Young's modulus, mm²: 1e-3 mN for a vessel of the tasks.
TOLERANCE_MM2 = 2e-6
#: The error at which methods are compared.
COMPARED_AT = 1e-2
#: What the errors are.
ERROR_OF = (
    "solver: largest distance of a node, at a frame's end, to RK4's at half the finest step, in shares of the way that "
    "the cut edge was drawn"
)
RESIDUAL_OF = "mN, Euclidean norm of the forces that backward Euler leaves unbalanced; nothing is left by the others"


@dataclass(frozen=True)
class Work:
    """A vessel that swings, how it begins, and where its nodes are at the end of each frame."""

    case: str
    model: Model
    plucked: Array  # (n, 3) mm, the beginning
    held: np.ndarray  # (n,) bool
    drawn_mm: float  # how far the cut edge is drawn
    tolerance_mN: float
    answers: Array  # (frames, n, 3) mm

    def begin(self) -> State:
        still = np.zeros_like(self.plucked)
        return State(self.plucked.copy(), still, self.held.copy(), np.zeros(len(self.model.links)))


class Swing:
    """One method with one step at work, and what its frames came to."""

    def __init__(self, work: Work, name: str, steps: int, method: Explicit | BackwardEuler) -> None:
        self.work, self.name, self.steps, self._method = work, name, steps, method
        self._state = work.begin()
        self._ms: list[float] = []
        self._error = self._residual = 0.0
        self._substeps = 0

    def frame(self) -> None:
        """Swings for a frame, timed."""
        at = len(self._ms)
        begun = perf_counter_ns()
        for _ in range(self.steps):
            self._substeps += self._method.step(self._state, FRAME_S / self.steps)
            if isinstance(self._method, BackwardEuler):
                self._residual = max(self._residual, self._method.residual_mN)
        self._ms.append((perf_counter_ns() - begun) * 1e-6)
        far = float(np.linalg.norm(self._state.x - self.work.answers[at], axis=1).max())
        self._error = worst(self._error, far / self.work.drawn_mm)

    def row(self) -> Row:
        frames = len(self._ms)
        median, p90 = median_and_p90(self._ms)
        divided = self._substeps - frames * self.steps
        status = "stable"
        if isinstance(self._method, BackwardEuler):
            status = "converged" if self._method.newton_steps > 1 else "one linear step"
        if divided:
            status = f"{status}, with {divided} substeps more"
        return Row(
            self.work.case, len(self.work.plucked), self.name, f"steps of {FRAME_S / self.steps * 1e6:.3g} µs", frames,
            median, p90, self._error, ERROR_OF, self._residual, status, RESIDUAL_OF, COMPARED_AT,
        )  # fmt: skip


def tube(layers: int, around: int, stiffness: str) -> tuple[Vessel, Model]:
    """A vessel with the shape of those in the task single-stitch and a modulus of MODULI_kPa; and its model."""
    given = Sourced(MODULI_kPa[stiffness], "assumed: as in the task single-stitch, or a five-hundredth of it")
    vessel = build(
        VesselSpec(
            name="A", cut_edge_mm=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), outer_diameter_mm=1.0, wall_mm=0.15,
            length_mm=2.0, layers=layers, around=around, modulus_kPa=given, puncture_outer_mN=given,
            puncture_inner_mN=given, tear_mN=given,
        )
    )  # fmt: skip
    mass = masses_of_links(vessel.mesh, given.value, DENSITY)
    dashpot = VISCOSITY / math.sqrt(given.value) * vessel.mesh.stiffness
    return vessel, model(vessel.mesh, mass, drag=DAMPING * mass, dashpot=dashpot)


def prepare(layers: int, around: int, stiffness: str, frames: int, parts: tuple[int, ...]) -> Work:
    """The vessel of a modulus in MODULI_kPa, its cut edge drawn aside, and the reference of its swing."""
    vessel, made = tube(layers, around, stiffness)
    mesh = vessel.mesh
    drawn, tolerance = PLUCKED * vessel.outer_radius_mm, TOLERANCE_MM2 * MODULI_kPa[stiffness]
    state = at_rest(mesh)
    cut = vessel.axial_mm == 0.0
    state.held[cut] = True
    draw = BackwardEuler(made, tolerance_mN=tolerance)
    for speed in (drawn / (DRAWING_STEPS * DRAWING_STEP_S), 0.0):
        state.v[cut] = speed * vessel.twelve
        for _ in range(DRAWING_STEPS):
            draw.step(state, DRAWING_STEP_S)
    answers = np.zeros((frames, *mesh.rest.shape))
    work = Work(f"swing, {stiffness} vessel", made, state.x, mesh.fixed, drawn, tolerance, answers)
    fine, state = Explicit(made, RK4, mesh.fixed), work.begin()
    steps = steps_a_frame(fine, REFERENCE_FINER * parts[-1])
    for answer in work.answers:
        for _ in range(steps):
            fine.step(state, FRAME_S / steps)
        answer[:] = state.x
    return work


def steps_a_frame(method: Explicit, parts: int) -> int:
    """Steps in a frame, each a whole substep of at most the stable step over ``parts``."""
    return math.ceil(FRAME_S / method.stable_step_s * parts)


def candidates(work: Work, quick: bool) -> list[Swing]:
    """The methods with their steps, as far as a frame of them can be waited for."""
    swings = []
    for method in METHODS:
        for parts in QUICK_PARTS if quick else PARTS:
            explicit = Explicit(work.model, method, work.held)
            steps = steps_a_frame(explicit, parts)
            if steps * _evaluations(method) <= (QUICK_MOST_EVALUATIONS if quick else MOST_EVALUATIONS):
                swings.append(Swing(work, method.name, steps, explicit))
    for name, newton_steps in (("linear backward Euler", 1), ("backward Euler", 30)):
        for steps in QUICK_STEPS_A_FRAME if quick else STEPS_A_FRAME:
            implicit = BackwardEuler(work.model, tolerance_mN=work.tolerance_mN, newton_steps=newton_steps)
            swings.append(Swing(work, name, steps, implicit))
    return swings


def _evaluations(method: Method) -> int:
    """Evaluations of the forces in a substep: as many as the order, for these three methods."""
    return method.order


def compare(work: Work, quick: bool) -> list[Row]:
    """All methods swing in turn, frame by frame, so that a noisy machine is noisy for all of them."""
    swings = candidates(work, quick)
    for _ in work.answers:
        for swing in swings:
            swing.frame()
    return [swing.row() for swing in swings]


def measure(quick: bool) -> list[Row]:
    """All rows; ``quick`` takes the small vessels only, and fewer steps. Kernels are compiled before."""
    compare(prepare(4, 8, "soft", 1, QUICK_PARTS), quick=True)
    parts = QUICK_PARTS if quick else PARTS
    rows: list[Row] = []
    for layers, around in MESHES[:1] if quick else MESHES:
        for stiffness in MODULI_kPa:
            rows += compare(prepare(layers, around, stiffness, FRAMES, parts), quick)
    return rows
