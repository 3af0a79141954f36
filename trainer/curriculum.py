"""Families of tasks as data: TOML in ``curricula/<family>/`` into frozen dataclasses.

A task says which components its scene has, what the trainee must do, how long, and what is measured
against which target. A component that is not named is ``None`` and costs nothing.
"""

from __future__ import annotations

import difflib
import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from trainer import config
from trainer.config import ANGLE_DEG, LENGTH_MM, POSITION_MM, Bounds, ConfigError, Sourced
from trainer.data_files import data_folder

Vector = tuple[float, float, float]

FORCE_MN = {"bounds": Bounds(0.0, 1e6, low_open=True)}
DRAG_MN = {"bounds": Bounds(0.0, 1e6)}
SUTURES = "sutures.toml"
#: A needle is at most so many outer diameters of a vessel long, along its arc. Assumed: it is four in our tasks, and
#: one of ten could hardly turn in the lumen; more is a slip of the pen or of the unit.
NEEDLE_DIAMETERS = 10.0
MOST_LINKS = 10_000  # assumed: a hundred times those of a stitch
MOST_ELEMENTS = 10**7  # of a block of a knee: more has mixed up a unit


@dataclass(frozen=True)
class Family:
    """``curriculum.toml``: what a family of tasks is and in which order a trainee meets them."""

    name: str
    title: str
    summary: str
    tasks: tuple[str, ...]


@dataclass(frozen=True)
class VesselSpec:
    """One clamped end of a vessel: a double-hulled tube (Brown 2001, section 3)."""

    name: str
    cut_edge_mm: Vector = field(metadata=POSITION_MM)  # centre of the cut plane
    axis: Vector = field(metadata={"bounds": Bounds(-1e3, 1e3)})  # direction from the cut into the end
    outer_diameter_mm: float = field(metadata=LENGTH_MM)
    wall_mm: float = field(metadata=LENGTH_MM)
    length_mm: float = field(metadata=LENGTH_MM)  # free length from the cut to the clamp
    layers: int = field(metadata={"bounds": Bounds(4, 2000)})
    around: int = field(metadata={"bounds": Bounds(8, 720)})  # nodes of a hull in one layer, even
    modulus_kPa: Sourced = field(metadata={"bounds": Bounds(1e-6, 1e9)})
    puncture_outer_mN: Sourced = field(metadata=FORCE_MN)
    puncture_inner_mN: Sourced = field(metadata=FORCE_MN)
    tear_mN: Sourced = field(metadata=FORCE_MN)  # pull on a hole at which it rips out

    def __post_init__(self) -> None:
        if self.wall_mm >= 0.5 * self.outer_diameter_mm:
            raise ValueError("'wall_mm' must be less than half of 'outer_diameter_mm'")
        if self.length_mm > 2.0 * self.outer_diameter_mm * self.layers:
            raise ValueError("'layers' are too few: they must lie at most two outer diameters apart")
        if self.around % 2:
            raise ValueError("'around' must be even, so that the links' diagonals can alternate")
        if math.hypot(*self.axis) < 1e-3:
            raise ValueError("'axis' must not be the zero vector")


@dataclass(frozen=True)
class NeedleSpec:
    """A circular needle, rigid, at the head of the thread (Brown 2001, section 4)."""

    arc_deg: float = field(metadata={"bounds": Bounds(10.0, 270.0)})  # 135 is a 3/8 circle
    length_mm: float = field(metadata=LENGTH_MM)  # along the arc
    wire_mm: float = field(metadata=LENGTH_MM)
    drag_mN: Sourced = field(metadata=DRAG_MN)  # friction of the wire in one hole
    skid_deg: Sourced = field(metadata={"bounds": Bounds(0.0, 90.0)})  # flatter than this the tip glides along a wall
    held_by: str = ""  # instrument that holds the needle when the exercise begins
    held_at: float = field(default=2 / 3, metadata={"bounds": Bounds(0.0, 1.0)})  # fraction of the arc from the tip


@dataclass(frozen=True)
class Suture:
    """A size in ``curricula/sutures.toml``."""

    diameter_mm: Sourced = field(metadata=LENGTH_MM)
    strength_mN: Sourced = field(metadata=FORCE_MN)


@dataclass(frozen=True)
class ThreadSpec:
    """The suture behind the needle: short rigid links (Brown 2001, section 4)."""

    size: str  # USP size, of those in curricula/sutures.toml: it says diameter and strength where the task does not
    length_mm: float = field(metadata=LENGTH_MM)
    link_mm: float = field(metadata=LENGTH_MM)
    diameter_mm: Sourced = field(metadata=LENGTH_MM)
    strength_mN: Sourced = field(metadata=FORCE_MN)
    drag_mN: Sourced = field(metadata=DRAG_MN)  # friction of the thread in one hole
    drapes: bool = False  # whether it lies over walls, blades and itself; else it passes through them, and costs less

    def __post_init__(self) -> None:
        if self.length_mm > MOST_LINKS * self.link_mm:
            raise ValueError(f"'length_mm' must be at most {MOST_LINKS} times 'link_mm'")
        if self.link_mm > self.length_mm:
            raise ValueError("'link_mm' must be at most 'length_mm': a thread has one link or more")


@dataclass(frozen=True)
class TissueSpec:
    """A structure of the anatomy that is free to move, and what it is made of (Gibson 1998, section 3.2)."""

    structure: str
    grown_to: tuple[str, ...]  # the structures that it is attached to
    stretch: Sourced = field(metadata={"bounds": Bounds(1.0, 100.0)})  # the greatest length of a link, in rest lengths
    compression: Sourced = field(metadata={"bounds": Bounds(0.0, 1.0, low_open=True)})  # the least length
    shear: Sourced = field(metadata={"bounds": Bounds(0.0, 100.0)})  # how far a link's ends may be offset sideways
    young_kPa: Sourced = field(metadata={"bounds": Bounds(1e-6, 1e9)})
    shear_kPa: Sourced = field(metadata={"bounds": Bounds(1e-6, 1e9)})
    time_constant_s: Sourced = field(metadata={"bounds": Bounds(1e-3, 1e3)})  # of elastic relaxation


@dataclass(frozen=True)
class KneeSpec:
    """A block of a knee; its frame is that of :mod:`trainer.anatomy.block`."""

    name: str  # a built-in knee; another one may be practised on (--anatomy)
    about: str  # the structure in whose middle the scene's origin is
    axis: Literal["up", "along"]  # y runs up the patient, or up along that structure
    voxel_mm: float = field(metadata={"bounds": Bounds(0.2, 2.0)})
    low_mm: Vector = field(metadata=POSITION_MM)
    high_mm: Vector = field(metadata=POSITION_MM)

    def __post_init__(self) -> None:
        size = [b - a for a, b in zip(self.low_mm, self.high_mm, strict=True)]
        if min(size) < 2.0 * self.voxel_mm:
            raise ValueError("'high_mm' must be greater than 'low_mm' by at least two voxels along each axis")
        if math.prod(size) > MOST_ELEMENTS * self.voxel_mm**3:
            raise ValueError(f"a block has at most {MOST_ELEMENTS} elements: 'voxel_mm' is too small")


@dataclass(frozen=True)
class AnatomySpec:
    """A volume of labelled elements: named structures move, all others are rigid (Gibson 1998, section 3.1)."""

    tissue: tuple[TissueSpec, ...]
    section: str = ""  # name of a drawn section of one layer, or …
    knee: KneeSpec | None = None
    hardness_mN_per_mm: Sourced | None = field(default=None, metadata=FORCE_MN)  # of what is rigid under a probe's tip

    def __post_init__(self) -> None:
        if bool(self.section) == (self.knee is not None):
            raise ValueError("an anatomy is either a 'section' or a 'knee'")
        names = [t.structure for t in self.tissue]
        if len(set(names)) != len(names):
            raise ValueError("two entries of 'tissue' are of the same structure")


@dataclass(frozen=True)
class InstrumentSpec:
    """One instrument and where it waits before the exercise."""

    tool: Literal["left", "right"]
    kind: Literal["forceps", "grasper", "scissors", "probe"]
    home_mm: Vector = field(metadata=POSITION_MM)
    home_rotation_deg: Vector = field(metadata=ANGLE_DEG)  # about x, then y, then z of the scene
    #: How far from the jaws' centre a thing can be to be caught; a probe's tip is a ball of this radius.
    reach_mm: float = field(metadata=LENGTH_MM)
    grip_mN: Sourced = field(metadata=FORCE_MN)  # the most the fully closed jaws hold against a pull
    close_at: float = field(default=0.7, metadata={"bounds": Bounds(0.05, 1.0)})  # closure that grasps
    open_at: float = field(default=0.5, metadata={"bounds": Bounds(0.0, 0.95)})  # closure that lets go
    tack_at: float | None = field(default=None, metadata={"bounds": Bounds(0.05, 1.0)})  # closure that tacks tissue
    portal_mm: Vector | None = field(default=None, metadata=POSITION_MM)  # where its shaft goes through the skin

    def __post_init__(self) -> None:
        if self.open_at >= self.close_at:
            raise ValueError("'open_at' must be less than 'close_at'")
        if self.tack_at is not None and (self.kind != "grasper" or self.tack_at <= self.close_at):
            raise ValueError("'tack_at' is for a grasper, and greater than 'close_at'")
        if self.portal_mm is not None and math.hypot(*self.portal_mm) < 1.0:
            raise ValueError("'portal_mm' must be at least 1 mm from the scene's origin, towards which it leads")


@dataclass(frozen=True)
class SceneSpec:
    """The components of the scene, and where the whole of it stands in the world."""

    instrument: tuple[InstrumentSpec, ...]
    vessel: tuple[VesselSpec, ...] = ()
    needle: NeedleSpec | None = None
    thread: ThreadSpec | None = None
    anatomy: AnatomySpec | None = None
    position_mm: Vector = field(default=(0.0, 0.0, 0.0), metadata=POSITION_MM)
    rotation_deg: Vector = field(default=(0.0, 0.0, 0.0), metadata=ANGLE_DEG)  # about x, then y, then z

    def __post_init__(self) -> None:
        for kind, names in (
            ("vessel", [v.name for v in self.vessel]),
            ("instrument", [i.tool for i in self.instrument]),
        ):
            if len(set(names)) != len(names):
                raise ValueError(f"two entries of '{kind}' share a name")
        if self.thread is not None and self.needle is None:
            raise ValueError("a 'thread' needs a 'needle' at its head")
        if self.needle is not None and self.needle.held_by not in {"", *(i.tool for i in self.instrument)}:
            raise ValueError(f"'needle.held_by' names no instrument: {self.needle.held_by!r}")
        if self.needle is not None:
            for v in self.vessel:
                _check_needle(self.needle, v)


def _check_needle(needle: NeedleSpec, vessel: VesselSpec) -> None:
    """Raises ValueError for a needle that cannot go through the wall of a vessel and turn in its lumen."""
    lumen, most = vessel.outer_diameter_mm - 2.0 * vessel.wall_mm, NEEDLE_DIAMETERS * vessel.outer_diameter_mm
    if needle.wire_mm >= lumen:
        raise ValueError(
            f"'needle.wire_mm' must be less than the lumen of vessel '{vessel.name}', {lumen:g} mm, "
            f"found {needle.wire_mm:g}"
        )
    if not vessel.wall_mm < needle.length_mm <= most:
        raise ValueError(
            f"'needle.length_mm' must be more than the wall of vessel '{vessel.name}', {vessel.wall_mm:g} mm, and at "
            f"most {NEEDLE_DIAMETERS:g} of its outer diameters, {most:g} mm, found {needle.length_mm:g}"
        )


@dataclass(frozen=True)
class SolverSpec:
    """How exact the simulation must be; the cheapest method that was measured to be so is taken (trainer.choice).

    A task without this table, or without a key of it, gets the default. Both are assumed: a hundredth of what a
    trainee sees, far below a tracker's noise; a hundredth of what the outer wall of a 1 mm vessel bears. What gives
    way is judged by forces: with 0.1 mN left over, nodes are within 0.003 mm, but one needle pierced 0.04 mm off.
    """

    #: Tolerated distance of a tissue's node from where it would come to rest.
    node_error_mm: float = field(default=0.003, metadata={"bounds": Bounds(0.0, 1000.0, low_open=True)})
    #: Tolerated unbalanced force, the Euclidean norm over all free nodes.
    force_error_mN: float = field(default=0.01, metadata=FORCE_MN)


@dataclass(frozen=True)
class Step:
    """One step of the goal; steps are reached in order.

    ``drive``: the needle's tip has gone through both walls of ``vessel`` in ``direction``, wherever that was: how far
    from the mark is for the metrics to say.
    ``withdraw``: needle and thread are out of every hole, and none tore. ``tail``: the thread left before its first
    hole is at most ``at_most_mm``. ``approximate``: the edges at the stitch are at most ``at_most_mm`` apart.

    ``grasp``: an instrument holds ``structure``. ``pull``: what is held of it is at least ``at_least_mm`` from where it
    rests. ``tack``: it is tacked, at least ``at_least_mm`` from where it rests. ``cut``: no path leads through it any
    more between what it is grown to. ``retract``: the cut ends are at least ``at_least_mm`` apart. How far from
    ``place_mm`` it was grasped or cut is for the metrics to say, too. ``probe``: a probe's tip touches ``structure``.
    """

    name: str
    kind: Literal["drive", "withdraw", "tail", "approximate", "grasp", "pull", "tack", "cut", "retract", "probe"]
    vessel: str = ""
    direction: Literal["in", "out"] = "in"
    clock_deg: float = field(default=0.0, metadata=ANGLE_DEG)  # the marked place
    bite_mm: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 1000.0)})
    at_most_mm: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 1000.0)})
    structure: str = ""
    at_least_mm: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 1000.0)})
    place_mm: Vector = field(default=(0.0, 0.0, 0.0), metadata=POSITION_MM)  # the marked place, of the scene at rest


#: Kinds of steps that handle a structure of the anatomy.
TISSUE_STEPS = ("grasp", "pull", "tack", "cut", "retract")
#: Those for which a structure is to be cut through, between what it is grown to.
SEVERING_STEPS = ("cut", "retract")
#: The instrument that such a step is done with.
DONE_WITH = {"grasp": "grasper", "pull": "grasper", "tack": "grasper", "cut": "scissors"}
#: What a task can limit, and the unit of its value: the rules of interaction ask about these and about no others.
LIMITS = {"tissue_pull": "mN", "grasp_pressure": "kPa", "probe_force": "mN"}


@dataclass(frozen=True)
class Limit:
    """A force or pressure that should not be exceeded."""

    value: float = field(metadata={"bounds": Bounds(0.0, 1e9, low_open=True)})
    unit: str
    source: str


@dataclass(frozen=True)
class MetricTarget:
    """A metric that the task wants, and the band that a supervisor hopes to see."""

    name: str
    source: str
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"'low' must be at most 'high', found {self.low:g} and {self.high:g}")


@dataclass(frozen=True)
class Task:
    """One exercise, as its TOML file states it."""

    name: str
    title: str
    summary: str
    time_limit_s: float = field(metadata={"bounds": Bounds(0.0, 86400.0, low_open=True)})
    scene: SceneSpec
    step: tuple[Step, ...]
    metric: tuple[MetricTarget, ...]
    limits: dict[str, Limit] = field(default_factory=dict)
    solver: SolverSpec = SolverSpec()
    tick_hz: float = field(default=100.0, metadata={"bounds": Bounds(20.0, 2000.0)})

    def __post_init__(self) -> None:
        vessels = {v.name: v for v in self.scene.vessel}
        for s in self.step:
            if s.kind == "drive" and s.vessel not in vessels:
                raise ValueError(f"step '{s.name}' names no vessel of the scene: {s.vessel!r}")
            if s.kind == "drive" and s.bite_mm > vessels[s.vessel].length_mm:
                raise ValueError(f"step '{s.name}': 'bite_mm' must not exceed the vessel's 'length_mm'")
        movable = {t.structure: t for t in self.scene.anatomy.tissue} if self.scene.anatomy else {}
        for s in self.step:
            if s.kind in TISSUE_STEPS and s.structure not in movable:
                raise ValueError(f"step '{s.name}' names no movable structure of the scene: {s.structure!r}")
            if s.kind in SEVERING_STEPS and len(set(movable[s.structure].grown_to)) < 2:
                raise ValueError(
                    f"step '{s.name}' cuts through what lies between two structures: "
                    f"'grown_to' of the {s.structure} must name both"
                )
            if s.kind == "probe" and (not movable or all(i.kind != "probe" for i in self.scene.instrument)):
                raise ValueError(f"step '{s.name}' needs an 'anatomy' and an instrument of kind 'probe'")
        if not self.step:
            raise ValueError("a task needs at least one 'step'")
        names = [m.name for m in self.metric]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two entries of 'metric' are of '{name}'")
        self._check_limits()
        self._check_instruments()

    def _check_limits(self) -> None:
        for name, limit in self.limits.items():
            if name not in LIMITS:
                near = difflib.get_close_matches(name, LIMITS, n=1, cutoff=0.5)
                hint = f", did you mean '{near[0]}'?" if near else f"; known: {', '.join(LIMITS)}"
                raise ValueError(f"unknown limit 'limits.{name}'{hint}")
            if limit.unit != LIMITS[name]:
                raise ValueError(f"'limits.{name}.unit' must be '{LIMITS[name]}', found '{limit.unit}'")

    def _check_instruments(self) -> None:
        for s in self.step:
            able = [i for i in self.scene.instrument if i.kind == DONE_WITH.get(s.kind)]
            if s.kind in DONE_WITH and not able:
                raise ValueError(f"step '{s.name}' needs an instrument of kind '{DONE_WITH[s.kind]}'")
            if s.kind == "tack" and all(i.tack_at is None for i in able):
                raise ValueError(f"step '{s.name}' needs a grasper with 'tack_at', the closure at which it tacks")


@dataclass(frozen=True)
class TaskFile:
    """A task together with the text it came from; the log stores both."""

    path: str  # family/task, or the path of a file outside the curricula
    text: str
    task: Task

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.text.encode()).hexdigest()


def parse_task(text: str, name: str) -> Task:
    """The task in a TOML text. Raises ConfigError."""
    return _task(config.parse_toml(text, name), name)


def _task(table: dict[str, Any], name: str) -> Task:
    """The task in a TOML table; what it does not say of its thread is that of the suture's size."""
    scene = table.get("scene")
    thread = scene.get("thread") if isinstance(scene, dict) else None
    if isinstance(thread, dict) and "size" in thread:
        known = sutures()
        if thread["size"] not in known:
            raise ConfigError(
                f"{name}: 'scene.thread.size' must be one of {', '.join(map(repr, known))} (curricula/{SUTURES}), "
                f"found {thread['size']!r}"
            )
        suture = known[thread["size"]]
        filled = {key: {"value": s.value, "source": s.source} for key, s in vars(suture).items()}
        table = {**table, "scene": {**table["scene"], "thread": {**filled, **thread}}}
    return config.build(Task, table, name)


def sutures() -> dict[str, Suture]:
    """The sizes of sutures that a task can name, the thickest first. Raises ConfigError."""
    path = data_folder("curricula") / SUTURES
    return {size: config.build(Suture, table, str(path), size) for size, table in config.read_toml(path).items()}


def load_task(reference: str) -> TaskFile:
    """The task ``FAMILY/TASK``, or the one in a ``.toml`` file. Raises ConfigError."""
    if reference.endswith(".toml"):
        path = Path(reference)
    else:
        family, _, task = reference.partition("/")
        if not task or family not in family_names() or task not in load_family(family).tasks:
            known = ", ".join(f"{f}/{t}" for f in family_names() for t in load_family(f).tasks)
            raise ConfigError(f"unknown task '{reference}'; known: {known}")
        path = data_folder("curricula") / family / f"{task}.toml"
    text = config.read_text(path)
    return TaskFile(path=reference, text=text, task=parse_task(text, str(path)))


def family_names() -> list[str]:
    """Names of the families, sorted."""
    return sorted(p.parent.name for p in data_folder("curricula").glob("*/curriculum.toml"))


def load_family(name: str) -> Family:
    """The family ``name``. Raises ConfigError."""
    path = data_folder("curricula") / name / "curriculum.toml"
    return config.build(Family, config.read_toml(path), str(path))


def check(path: Path, check_task: Callable[[Task], None]) -> list[str]:
    """What is wrong with a task file, a family file or a folder of them; empty when nothing is.

    ``check_task`` raises ConfigError for a task that cannot be scored or simulated as it asks.
    """
    if path.is_dir():
        files = sorted(path.rglob("*.toml"))
        return [p for f in files for p in check(f, check_task)] if files else [f"{path}: holds no TOML file"]
    try:
        table = config.read_toml(path)
        if path.name == "curriculum.toml":
            family = config.build(Family, table, str(path))
            return [
                f"{path}: task '{t}' has no file {t}.toml"
                for t in family.tasks
                if not (path.parent / f"{t}.toml").exists()
            ]
        if path.name == SUTURES:
            for size, suture in table.items():
                config.build(Suture, suture, str(path), size)
            return []
        task = _task(table, str(path))
    except ConfigError as error:
        return [str(error)]
    problems = []
    if task.name != path.stem:
        problems.append(f"{path}: 'name' must equal the file's name, found '{task.name}'")
    try:
        check_task(task)
    except ConfigError as error:
        problems.append(f"{path}: {error}")
    return problems
