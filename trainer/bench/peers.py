"""The bare chain's swing in MuJoCo and PyElastica, where they are installed beside the program; no dependencies.

MuJoCo: the same point masses on massless links with ball joints without friction. Each link is a body whose mass sits
in a small sphere at its far end, so that the model differs from the reference by the sphere's own inertia, (r / d)².
PyElastica: a Cosserat rod, pinned at its first node, with as many elements as the chain has links. It stretches and
bends: its radius and axial stiffness trade that error against the step, which its fastest wave bounds.

A round is a whole swing of each method with each setting, one after the other: frame by frame in turn each would find
the caches full of the others' numbers, which costs the lightest most. A method's figure is the median over the rounds
of the round's median frame; ratios are taken within a round, whose swings follow one another within seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from trainer.bench import thread
from trainer.bench.rows import Row
from trainer.geometry import Array
from trainer.mechanics.thread_rod import Holds, RodModel, holds

MUJOCO_STEPS_S = (5e-3, 2e-3, 1e-3, 5e-4)
ELASTICA = ((10.0, 1e-3), (3.0, 1e-3), (3.0, 5e-4))  # axial stiffness, N, and radius, m
ELASTICA_STEP = 0.8  # of the shortest time that a wave of stretch takes along, or one of shear across, an element
ROUNDS = 5
#: Module and distribution of each peer.
PEERS = {"mujoco": "mujoco", "elastica": "pyelastica"}
CASE = "swing, bare"
MISSING = "not measured: {} is not installed"


class MuJoCo:
    """MuJoCo's Runge-Kutta integrator at a step (s)."""

    name = "mujoco ball chain"

    def __init__(self, model: RodModel, step_s: float) -> None:
        import mujoco  # type: ignore[import-not-found, unused-ignore]

        self.engine, self.link, self.steps = mujoco, model.link, round(thread.FRAME_S / step_s)
        self.setting = f"RK4, {step_s * 1e3:g} ms"
        links, link, mass = model.count - 1, model.link * 1e-3, model.mass * model.link
        bodies = ""
        for i in range(links):
            m = mass * (0.5 if i == links - 1 else 1.0)
            place = 0.0 if i == 0 else link
            bodies += (
                f'<body pos="{place} 0 0"><joint type="ball" armature="0" damping="0"/>'
                f'<inertial pos="{link} 0 0" mass="{m}" diaginertia="{m * 1e-8} {m * 1e-8} {m * 1e-8}"/>'
            )
        text = (
            f'<mujoco><option timestep="{step_s}" gravity="0 0 -9.81" integrator="RK4"/>'
            f'<compiler boundmass="0" boundinertia="0"/><worldbody>{bodies}{"</body>" * links}</worldbody></mujoco>'
        )
        self.built = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.built)
        mujoco.mj_forward(self.built, self.data)

    def frame(self, places: Array) -> Array:
        for _ in range(self.steps):
            self.engine.mj_step(self.built, self.data)
        self.engine.mj_kinematics(self.built, self.data)
        x = np.zeros((len(self.data.xpos), 3))
        x[:-1] = np.asarray(self.data.xpos)[1:] * 1e3
        x[-1] = x[-2] + self.link * np.asarray(self.data.xmat)[-1].reshape(3, 3)[:, 0]
        return x


class Elastica:
    """PyElastica's position Verlet integrator with an axial stiffness (N) and a radius (m)."""

    name = "pyelastica rod"

    def __init__(self, model: RodModel, axial: float, radius: float) -> None:
        import elastica  # type: ignore[import-not-found, unused-ignore]

        links, length, mass = model.count - 1, model.length * 1e-3, model.mass * 1e3
        area = math.pi * radius**2
        self.rod = elastica.CosseratRod.straight_rod(
            links, np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), length, radius, mass / area,
            youngs_modulus=axial / area, shear_modulus=axial / area / 2.0,
        )  # fmt: skip

        class Simulator(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing):  # type: ignore[misc]
            pass

        simulator: Any = Simulator()
        simulator.append(self.rod)
        simulator.constrain(self.rod).using(
            elastica.GeneralConstraint, constrained_position_idx=(0,),
            translational_constraint_selector=np.array([True, True, True]),
        )  # fmt: skip
        simulator.add_forcing_to(self.rod).using(elastica.GravityForces, acc_gravity=np.array([0.0, 0.0, -9.81]))
        simulator.finalize()
        self.simulator, self.stepper, self.time = simulator, elastica.PositionVerlet(), np.float64(0.0)
        wave = math.sqrt(axial / mass)
        shortest = min(length / links / wave, 0.5 * radius / (wave * math.sqrt(0.5)))
        self.steps = math.ceil(thread.FRAME_S / (ELASTICA_STEP * shortest))
        self.setting = f"EA {axial:g} N, radius {radius * 1e3:g} mm, {thread.FRAME_S / self.steps:.1e} s"

    def frame(self, places: Array) -> Array:
        for _ in range(self.steps):
            self.time = self.stepper.step(self.simulator, self.time, np.float64(thread.FRAME_S / self.steps))
        return np.ascontiguousarray(self.rod.position_collection.T) * 1e3


@dataclass(frozen=True)
class Swings:
    """A method with a setting, swung once a round."""

    row: Row  # its times are medians over the rounds, its error is the worst
    rounds_ms: tuple[float, ...]  # median frame of each round
    peer: bool


def installed() -> dict[str, str]:
    """The versions of the peers that are here."""
    found = {}
    for distribution in PEERS.values():
        try:
            found[distribution] = version(distribution)
        except PackageNotFoundError:
            continue
    return found


def measure(links: int = 50, rounds: int = ROUNDS) -> list[Swings]:
    """The rod, the chain and the peers that are found, each ``rounds`` times; of the others rows that say so.

    A swing before the first round compiles, and is not counted. The order turns by one from round to round.
    """
    model = thread.bare(links)
    h = thread.reference_step(model)

    def held() -> Holds:
        return holds(model, [0], [[0, 0, 0]])

    builders: list[tuple[str, Callable[[], thread.Method]]] = []
    builders += [("", partial(thread.Rod, model, held(), t * model.length, True)) for t in (1e-3, 1e-4, 1e-5)]
    builders += [("", partial(thread.Chain, model, held(), t * model.length)) for t in (1e-2, 1e-3, 1e-5, 1e-6)]
    builders += [("mujoco", partial(MuJoCo, model, step_s)) for step_s in MUJOCO_STEPS_S]
    builders += [("elastica", partial(Elastica, model, *setting)) for setting in ELASTICA]
    expected, of = thread.answers(model, thread.still, h), thread.REFERENCE.format(links, h)
    missing: list[Swings] = []
    for module in PEERS:
        try:
            next(build for name, build in builders if name == module)().frame(np.zeros((2, 3)))
        except ImportError:
            said, nan = MISSING.format(module), float("nan")
            missing.append(Swings(Row(CASE, links, module, "-", 0, nan, nan, nan, said, nan, said), (), True))
            builders = [(name, build) for name, build in builders if name != module]
    for name, build in builders:
        if not name:
            thread.run(CASE, model, thread.still, [build()], expected[:3], of)
    swung: list[list[Row]] = [[] for _ in builders]
    for turn in range(rounds):
        for k in np.roll(np.arange(len(builders)), -turn).tolist():
            swung[k] += thread.run(CASE, model, thread.still, [builders[k][1]()], expected, of)
    return [_swings(rows, bool(name)) for rows, (name, _) in zip(swung, builders, strict=True)] + missing


def _swings(rows: list[Row], peer: bool) -> Swings:
    ms = tuple(row.median_ms for row in rows)
    worst = max(rows, key=lambda row: row.error)
    p90 = float(np.median([row.p90_ms for row in rows]))
    frames = sum(row.frames for row in rows)
    return Swings(replace(worst, frames=frames, median_ms=float(np.median(ms)), p90_ms=p90), ms, peer)
