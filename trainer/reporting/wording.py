"""Names, numbers and events in words, the same on paper and on the terminal."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from datetime import datetime

from trainer.events import (
    Break,
    Contact,
    Cut,
    Drape,
    Drop,
    Event,
    Grasp,
    Overforce,
    Pierce,
    PortalEnter,
    PortalExit,
    Probe,
    PullThrough,
    Release,
    Slip,
    StepDone,
    Tack,
    TaskDone,
    TaskStarted,
    Tear,
    TickOverrun,
    TrackingBack,
    TrackingLost,
    Undrape,
    Withdraw,
    payload,
)

DISCLAIMER = "Training feedback, not a certificate."

KNEES_APART = "Attempts at a task in different knees are counted apart: what is hard in one may be easy in the other."

#: From here on a force is told in newtons.
LARGE_MN = 10_000.0

#: So many reasons why a device did not see an instrument are told in one line.
MOST_REASONS = 3

#: Titles that say what a name cannot; an exercise's duration begins with the exercise.
_TITLES = {"time_s": "Time from first motion"}

#: Units that are no part of a reader's language.
_UNIT_WORDS = {"deg": "°", "count": "", "ratio": "", "mm3": "mm³"}


def title(metric: str) -> str:
    """A metric's name for a reader: without its unit and with spaces."""
    if metric in _TITLES:
        return _TITLES[metric]
    for suffix in ("_deg", "_mm", "_mm3", "_s", "_mN"):
        metric = metric.removesuffix(suffix)
    words = metric.replace("_", " ")
    return words[:1].upper() + words[1:]


def within(title: str, anatomy: str) -> str:
    """A task's title with the knee that it was practised in, where it has one."""
    return f"{title} – {anatomy}" if anatomy else title


def unit_word(unit: str) -> str:
    return _UNIT_WORDS.get(unit, unit)


def number(value: float | None, unit: str = "") -> str:
    """A value with as many digits as its unit deserves; a dash for None."""
    if value is None:
        return "–"
    digits = {"deg": 1, "mm": 2, "mm3": 0, "s": 1, "mN": 1, "count": 0, "ratio": 2}.get(unit, 2)
    if unit == "mm" and abs(value) >= 100.0:
        digits = 0
    text = f"{value:.{digits}f}"
    return "0.0" if (unit, text) == ("deg", "360.0") else text  # a full turn is 12 o'clock


def clock(angle_deg: float) -> str:
    """A clock angle in whole degrees, 0° to 359°: what rounds to a full turn is 12 o'clock."""
    return f"{round(angle_deg) % 360}°"


def quantity(value: float | None, unit: str) -> str:
    """A value with its unit; a large force in newtons."""
    if unit == "mN" and value is not None and abs(value) >= LARGE_MN:
        return f"{1e-3 * value:.1f} N"
    word = unit_word(unit)
    gap = "" if word in ("", "°") else " "
    return number(value, unit) + (gap + word if value is not None else "")


def band(low: float | None, high: float | None, unit: str) -> str:
    """A target band in words; empty without a target. A large force is in newtons."""
    if unit == "mN" and max(low or 0.0, high or 0.0) >= LARGE_MN:
        low, high = (None if limit is None else 1e-3 * limit for limit in (low, high))
        unit = "N"
    word = unit_word(unit)
    tail = word if word in ("", "°") else f" {word}"
    if low is not None and high is not None:
        return f"{low:g}{tail}" if low == high else f"{low:g} to {high:g}{tail}"
    if high is not None:
        return f"at most {high:g}{tail}"
    return f"at least {low:g}{tail}" if low is not None else ""


def date(started_at: str) -> str:
    """The day and hour of an ISO 8601 time, by the clock of the reader's machine."""
    moment = datetime.fromisoformat(started_at).astimezone()
    return f"{moment.day} {moment:%B %Y, %H:%M}"


def duration(seconds: float) -> str:
    """Minutes and seconds."""
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60:02d} s" if whole >= 60 else f"{seconds:.1f} s"


def kind_word(kind: str) -> str:
    """An event's kind for a reader: a tip touches a structure, be it a probe's or not."""
    return "touch" if kind == "probe" else kind.replace("_", " ")


def _force(value: float, unit: str = "mN") -> str:
    """A force or pressure of an event, in whole millinewtons or, a large one, in newtons."""
    return quantity(value, unit) if unit == "mN" and value >= LARGE_MN else f"{value:.0f} {unit}"


def _place(axial_mm: float, clock_deg: float) -> str:
    return f"{axial_mm:.2f} mm from the cut at {clock(clock_deg)}"


def _held(target: str, body: str) -> str:
    return f"{target} of {body}" if body else target


def _lain_over(over: str, body: str) -> str:
    return body or {"instrument": "the instrument", "thread": "itself"}.get(over, over)


def unseen(events: Sequence[TrackingLost | TrackingBack]) -> str:
    """How long one hand was out of the device's sight, of its losses and returns in a row."""
    returns = [e.lost_s for e in events if isinstance(e, TrackingBack)]
    if len(events) == 1:
        return describe(events[0])
    words = "not seen by the device"
    if returns:
        words += f" for {sum(returns):.2f} s{' in all' if len(returns) > 1 else ''}"
        words += ", then lost again" if isinstance(events[-1], TrackingLost) else ""
    return words + _why([e.reason for e in events if isinstance(e, TrackingLost)])


def out_of_sight(events: Sequence[Event]) -> str:
    """Which hands the device did not see, for how long and why, of all events of a session; "" where it saw all."""
    told: dict[str, list[str]] = {}
    for tool in sorted({e.tool for e in events if isinstance(e, TrackingLost)}):
        own = [e for e in events if isinstance(e, TrackingLost | TrackingBack) and e.tool == tool]
        told.setdefault(unseen(own), []).append(tool)
    return "; ".join(f"{' and '.join(tools)} {words}" for words, tools in told.items())


def _why(reasons: Sequence[str]) -> str:
    """The reasons after a colon, the most frequent first; nothing where there are none."""
    known = [reason for reason, _ in Counter(filter(None, reasons)).most_common()]
    if len(known) > MOST_REASONS:
        known[MOST_REASONS:] = ["and others"]
    return f": {'; '.join(known)}" if known else ""


def describe(event: Event) -> str:
    """What happened, in a few words; the bare fields of a kind that has no words of its own."""
    match event:
        case Grasp() if event.target == "tissue":
            return _held(event.target, event.body)
        case Grasp():
            return f"{_held(event.target, event.body)}, {event.force_mN:.0f} mN"
        case Release():
            return _held(event.target, event.body)
        case Slip():
            return f"{_held(event.target, event.body)} at {_force(event.load_mN)}"
        case Drop():
            return event.target
        case Contact():
            return f"{event.wall} wall of {event.body}, {_place(event.axial_mm, event.clock_deg)}"
        case Pierce():
            where = f"{event.wall} wall of {event.body}, {event.direction}, {_place(event.axial_mm, event.clock_deg)}"
            return f"{where}; {event.entry_angle_deg:.0f}° to the wall, {event.force_mN:.1f} mN"
        case Withdraw():
            return f"{event.end} out of the {event.wall} wall of {event.body}"
        case PullThrough():
            return f"{event.wall} wall of {event.body}"
        case Drape():
            return f"thread over {_lain_over(event.over, event.body)}"
        case Undrape():
            return f"thread off {_lain_over(event.over, event.body)} after {event.lay_s:.1f} s"
        case Break():
            return f"thread at {event.tension_mN:.0f} mN"
        case Tear() if not event.wall:
            return f"{event.body}, {event.volume_mm3:.0f} mm³"
        case Cut():
            return f"{event.body}, {event.volume_mm3:.0f} mm³"
        case Tack():
            return f"{event.body}, {event.volume_mm3:.0f} mm³ at {_force(event.force_mN)}"
        case Probe():
            return f"{event.body}, {_force(event.force_mN)}" if event.force_mN else event.body
        case PortalEnter():
            return "in through the portal"
        case PortalExit():
            return "out of the portal"
        case Tear():
            return f"{event.wall} wall of {event.body} at {event.force_mN:.0f} mN"
        case Overforce():
            where = f" on {event.body}" if event.body else ""
            limit = f"{_force(event.value, event.unit)}, limit {_force(event.limit, event.unit)}"
            return f"{event.quantity.replace('_', ' ')}{where}: {limit}"
        case TrackingLost():
            return f"not seen by the device{_why([event.reason])}"
        case TrackingBack():
            return f"seen again after {event.lost_s:.2f} s"
        case TickOverrun():
            skipped = f", then {event.skipped_s:.2f} s skipped" if event.skipped_s else ""
            return f"{event.work_ms:.1f} ms of work in {event.slot_ms:.1f} ms{skipped}"
        case TaskStarted():
            return event.task
        case StepDone():
            return event.step
        case TaskDone():
            return f"{event.outcome}: {event.reason}" if event.reason else event.outcome
        case _:
            return ", ".join(str(v) for v in json.loads(payload(event)).values())
