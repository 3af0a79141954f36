"""The vocabulary of the log: one frozen dataclass per kind of event.

An event is written once, by the rule that saw it happen, and never changed. ``(tick, seq)`` orders all
events of a session; ``time_s`` may lie inside the tick (an interpolated crossing). Vectors are tuples of
three floats in the world frame, mm or unit length. Each class docstring is the documentation of its kind.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any, ClassVar

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Event:
    """What all kinds share."""

    kind: ClassVar[str] = ""
    #: False for an event that depends on the machine's clock: a replay does not reproduce it.
    simulated: ClassVar[bool] = True

    tick: int
    seq: int  # order within the tick
    time_s: float  # s from the start of the session
    tool: str  # instrument, or "" where none takes part


@dataclass(frozen=True)
class Grasp(Event):
    """The jaws closed on something and hold it."""

    kind = "grasp"
    target: str  # needle, thread, wall or tissue
    body: str  # vessel or structure, or ""
    arc_mm: float  # along needle and thread from the needle's tip; 0 for a wall and tissue
    point: Vector  # of tissue in a volume: where it rests
    force_mN: float  # the pull that this grip resists


@dataclass(frozen=True)
class Release(Event):
    """The jaws opened and let go."""

    kind = "release"
    target: str
    body: str


@dataclass(frozen=True)
class Slip(Event):
    """The load exceeded what the grip can hold, and the held thing slid out of the jaws.

    ``load_mN`` is that of the tissue's equilibrium. A thread without holes and a needle in two grips are rigid: their
    load rises until something gives way, and is the limit then.
    """

    kind = "slip"
    target: str
    body: str
    load_mN: float
    limit_mN: float


@dataclass(frozen=True)
class Drop(Event):
    """The needle was let go with no instrument and no tissue holding it."""

    kind = "drop"
    target: str
    point: Vector


@dataclass(frozen=True)
class Contact(Event):
    """The needle's tip touched a wall of a vessel."""

    kind = "contact"
    body: str
    wall: str  # outer or inner
    direction: str  # in (towards the lumen) or out
    point: Vector
    axial_mm: float  # material coordinate: distance from the cut edge
    clock_deg: float  # material coordinate: clock angle


@dataclass(frozen=True)
class Pierce(Event):
    """The needle's tip went through a wall; all values are those of the instant of crossing.

    ``force_mN`` is the force of the tip on the wall that made it give way: along the needle the wall's puncture force;
    of a tip that was pushed aside the whole force, which is then twice as much.
    """

    kind = "pierce"
    body: str
    wall: str  # outer or inner
    direction: str  # in (towards the lumen) or out
    pass_number: int  # from 1; a new pass begins when the tip pierces while the needle is in no hole
    hole: int  # number of the hole, from 0
    point: Vector
    axial_mm: float  # material coordinate: distance from the cut edge
    clock_deg: float  # material coordinate: clock angle
    tangent: Vector  # the needle's direction at its tip
    normal: Vector  # outward normal of the undented wall
    entry_angle_deg: float  # angle of tangent to the wall's tangent plane, 0..90
    force_mN: float
    depth_mm: float  # depth of the tip below the undented outer surface, along the normal


@dataclass(frozen=True)
class Withdraw(Event):
    """Needle or thread left a hole: the tip backwards out of it, or the end of the thread through it."""

    kind = "withdraw"
    body: str
    wall: str
    hole: int
    pass_number: int
    end: str  # tip or tail
    reached_mm: float  # how far the tip advanced beyond this wall, along its undented normal


@dataclass(frozen=True)
class PullThrough(Event):
    """The needle's rear end passed through a hole, which holds thread from now on."""

    kind = "pull_through"
    body: str
    wall: str
    hole: int
    pass_number: int
    reached_mm: float  # how far the tip advanced beyond this wall, along its undented normal


@dataclass(frozen=True)
class Drape(Event):
    """The thread has come to lie over something: an instrument (the tool), a vessel, or itself."""

    kind = "drape"
    over: str  # instrument, vessel or thread
    body: str  # vessel, or ""
    arc_mm: float  # where along needle and thread from the needle's tip
    point: Vector


@dataclass(frozen=True)
class Undrape(Event):
    """The thread no longer lies over it: nothing of it has been near for a tenth of a second."""

    kind = "undrape"
    over: str
    body: str
    lay_s: float  # for how long it lay there


@dataclass(frozen=True)
class Break(Event):
    """The thread's tension exceeded its strength: as of a slip, the measured one, or the limit of a rigid thread."""

    kind = "break"
    arc_mm: float  # where, along needle and thread from the needle's tip
    tension_mN: float
    limit_mN: float


@dataclass(frozen=True)
class Tear(Event):
    """A wall gave way: a hole pulled out, or grasped tissue ripped from the jaws; or links of a volume did."""

    kind = "tear"
    body: str  # vessel or structure
    wall: str  # "" in a volume
    hole: int  # -1 where grasped tissue tore, and in a volume
    point: Vector
    force_mN: float
    limit_mN: float  # 0 in a volume, which tears at a strain
    volume_mm3: float = 0.0  # of the elements of a volume that lost a link


@dataclass(frozen=True)
class Cut(Event):
    """Blades closed through a structure: one stroke, written when they are closed or open again."""

    kind = "cut"
    body: str
    point: Vector  # the middle of what was cut, where it rests
    volume_mm3: float  # of the elements that lost a link


@dataclass(frozen=True)
class Tack(Event):
    """The jaws fixed what they hold where it is."""

    kind = "tack"
    body: str
    point: Vector
    volume_mm3: float  # of the elements that were fixed
    force_mN: float  # pull of the tissue on them


@dataclass(frozen=True)
class Probe(Event):
    """The tip of an instrument went into something rigid, or that of a probe touched a structure."""

    kind = "probe"
    body: str  # structure
    point: Vector
    force_mN: float = 0.0  # on the tip of a probe


@dataclass(frozen=True)
class PortalEnter(Event):
    """The tip of an instrument went in through its portal, about which its shaft turns from now on."""

    kind = "portal_enter"
    point: Vector


@dataclass(frozen=True)
class PortalExit(Event):
    """The tip of an instrument came out of its portal."""

    kind = "portal_exit"
    point: Vector


@dataclass(frozen=True)
class Overforce(Event):
    """A force or pressure rose above the task's limit (once per excursion, not per tick)."""

    kind = "overforce"
    body: str
    quantity: str  # name of the limit in the task's [limits]
    value: float
    limit: float
    unit: str


@dataclass(frozen=True)
class TrackingLost(Event):
    """The device no longer sees the instrument, which stays where it was last seen."""

    kind = "tracking_lost"
    reason: str = ""  # as the device knew it at that tick; "" in older logs and where the device does not know


@dataclass(frozen=True)
class TrackingBack(Event):
    """The device sees the instrument again."""

    kind = "tracking_back"
    lost_s: float


@dataclass(frozen=True)
class TickOverrun(Event):
    """A tick took longer than its time slot, or what lay between it and the next did, and time was skipped."""

    kind = "tick_overrun"
    simulated = False
    work_ms: float
    slot_ms: float
    skipped_s: float = 0.0  # time on the wall that no tick stands for: the session went on from where it was


@dataclass(frozen=True)
class TaskStarted(Event):
    """The first tick of the exercise."""

    kind = "task_started"
    task: str


@dataclass(frozen=True)
class StepDone(Event):
    """A step of the task's goal was reached."""

    kind = "step_done"
    step: str
    index: int  # from 0


@dataclass(frozen=True)
class Aborted(Event):
    """The trainee stopped the exercise."""

    kind = "aborted"
    reason: str


@dataclass(frozen=True)
class TaskDone(Event):
    """The exercise ended; the fields tell where everything is."""

    kind = "task_done"
    outcome: str  # completed, failed, aborted or timeout
    reason: str
    needle_tip: Vector
    needle_tangent: Vector  # at the tip
    thread_end: Vector
    thread_length_error: float  # largest relative error of a link's length
    tail_mm: float  # thread left before the first hole; 0 without a thread in a hole
    gap_mm: float  # distance of the two ends' edges at the stitch, or of a structure's cut ends; 0 without either
    pull_max_mN: float = 0.0  # the greatest pull of an instrument on tissue of a volume
    press_max_mN: float = 0.0  # the greatest force on the tip of a probe


KINDS: dict[str, type[Event]] = {
    cls.kind: cls
    for cls in (
        Grasp, Release, Slip, Drop, Contact, Pierce, Withdraw, PullThrough, Drape, Undrape, Break, Tear, Cut, Tack,
        Probe, PortalEnter, PortalExit, Overforce, TrackingLost, TrackingBack, TickOverrun, TaskStarted, StepDone,
        Aborted, TaskDone,
    )
}  # fmt: skip

_SHARED = tuple(f.name for f in dataclasses.fields(Event))


def payload(event: Event) -> str:
    """The fields of one kind as a JSON object, keys in the order of the class; floats round-trip exactly."""
    values = {k: v for k, v in dataclasses.asdict(event).items() if k not in _SHARED}
    return json.dumps(values, allow_nan=False)


def from_row(tick: int, seq: int, time_s: float, tool: str, kind: str, data: str) -> Event:
    """The event of a stored row. Raises ValueError for an unknown kind or fields that do not fit it."""
    cls = KINDS.get(kind)
    if cls is None:
        raise ValueError(f"unknown kind of event {kind!r}")
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in json.loads(data).items()}
    try:
        return cls(tick=tick, seq=seq, time_s=time_s, tool=tool, **values)
    except TypeError as error:
        raise ValueError(f"event {kind!r} at tick {tick}: {error}") from None
