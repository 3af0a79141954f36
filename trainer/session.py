"""The loop, and nothing else: device → scene → sinks, one tick after the other."""

from __future__ import annotations

import gc
import math
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType
from typing import Any, Protocol

import numpy as np

from trainer.clock import Fast
from trainer.drivers.driver import Driver, LiveDriver
from trainer.events import Event, TickOverrun
from trainer.geometry import Array
from trainer.poses import ToolPoses
from trainer.sinks.surface import Sink, TickRecord

#: Why an instrument counts as not seen whose numbers cannot be taken.
NO_POSE = "its numbers are no pose"


class Scene(Protocol):
    """What the loop needs of :class:`trainer.scene.Scene`."""

    home: ToolPoses

    @property
    def tick(self) -> int: ...

    @property
    def outcome(self) -> str: ...

    def step(self, poses: ToolPoses) -> tuple[Event, ...]: ...

    def finish(self, outcome: str, reason: str) -> tuple[Event, ...]: ...

    def view(self) -> Any: ...

    def snapshot(self) -> Array: ...


def run(
    scene: Scene,
    driver: Driver,
    sinks: Sequence[Sink],
    clock: Fast,
    interrupted: Callable[[], bool] = lambda: False,
) -> None:
    """Run ``scene`` until it has an outcome; every sink gets one record per tick.

    Where the session ends because the input did or the trainee interrupted it, the closing events come in a
    second record of the last tick. An overrun is logged, in real time only, with the record after it, when its
    length is known: that of the last tick in one more record of it.

    A device in a hand is asked when the slot of a tick has begun: the newest pose counts. A scripted hand looks at the
    scene and decides, and a file is read, while the slot is waited for; that is no work of the tick.
    """
    poses = scene.home
    tick = 0
    work_ms, late = 0.0, False
    in_hand = isinstance(driver, LiveDriver)
    seen: ToolPoses | None = None
    while not scene.outcome:
        if not in_hand:
            seen = driver.poll(scene.tick, scene.view())
        skipped_s = clock.begin()
        if in_hand:
            seen = driver.poll(scene.tick, scene.view())
        if interrupted():
            events = scene.finish("aborted", "interrupted")
        elif seen is None:
            events = scene.finish("failed", "the input ended before the task was done")
        else:
            tick = scene.tick
            poses = admit(seen, poses)
            events = scene.step(poses)
        if late or skipped_s:
            events = (*events, _overrun(tick, events, work_ms, skipped_s, clock))
        record = TickRecord(tick, tick / clock.tick_hz, poses, events, scene.snapshot)
        for sink in sinks:
            sink.tick(record)
        work_ms = clock.end()
        late = clock.realtime and work_ms > clock.slot_ms
    if late:
        record = replace(record, events=(_overrun(tick, record.events, work_ms, 0.0, clock),))
        for sink in sinks:
            sink.tick(record)


def admit(seen: ToolPoses, held: ToolPoses) -> ToolPoses:
    """``seen``, where each instrument whose numbers are no pose keeps that of ``held`` and counts as not seen.

    A pose is finite and its quaternion of length 1 within 1e-6, and a closure lies between 0 and 1, which is what the
    sinks and the scene rely on; a closure beyond is cut off.
    """
    rows = zip(seen.position.tolist(), seen.quaternion.tolist(), seen.closure.tolist(), strict=True)
    are_poses = [_is_pose(*row) for row in rows]
    if all(are_poses) and all(0.0 <= closure <= 1.0 for closure in seen.closure.tolist()):
        return seen
    pose = np.array(are_poses, dtype=np.bool_)
    return ToolPoses(
        position=np.where(pose[:, None], seen.position, held.position),
        quaternion=np.where(pose[:, None], seen.quaternion, held.quaternion),
        closure=np.clip(np.where(pose, seen.closure, held.closure), 0.0, 1.0),
        valid=seen.valid & pose,
        reason=tuple(seen.why_lost(i) or ("" if is_pose else NO_POSE) for i, is_pose in enumerate(pose)),
    )


def _is_pose(position: list[float], quaternion: list[float], closure: float) -> bool:
    """By scalars: a tick begins with this, when nothing of numpy is in the caches."""
    norm = sum(q * q for q in quaternion)  # of what is no number, or too large, no number below
    return all(map(math.isfinite, (*position, closure))) and abs(norm - 1.0) < 2e-6


def _overrun(tick: int, events: tuple[Event, ...], work_ms: float, skipped_s: float, clock: Fast) -> TickOverrun:
    """The event that follows ``events``: the tick before took ``work_ms``, and ``skipped_s`` were skipped after it."""
    seq = 0
    if events:
        tick, seq = events[-1].tick, events[-1].seq + 1
    return TickOverrun(tick, seq, tick / clock.tick_hz, "", work_ms=work_ms, slot_ms=clock.slot_ms, skipped_s=skipped_s)


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Ctrl-C asks instead of raising, so that a tick is never left half done; a second Ctrl-C raises."""
    asked = False

    def ask(signum: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def old_objects_left_alone() -> Iterator[None]:
    """What exists now is not searched for garbage until the end: a search through all that numba has made takes 100 ms,
    and one falls into most sessions."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
