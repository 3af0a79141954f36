"""What a sink is given at every tick. A sink writes it down; it never decides anything.

A sink has ``tick(step)`` for every tick, ``close()`` at the end, and is made for one session.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trainer.events import Event
from trainer.geometry import Array
from trainer.poses import ToolPoses


@dataclass(frozen=True)
class Surface:
    """A part of the scene that does not change its topology."""

    name: str  # e.g. vessel/A
    triangles: np.ndarray  # (f, 3) int32
    rgba: tuple[int, int, int, int]
    fixed: Array | None = None  # (v, 3) mm, world, of what does not move; None where a frame tells


@dataclass(frozen=True)
class InstrumentPart:
    """A rigid part of an instrument: a mesh in its own frame."""

    name: str  # e.g. right/upper
    tool: int
    vertices: Array  # (v, 3) mm, part frame
    triangles: np.ndarray  # (f, 3) int32


@dataclass(frozen=True)
class Cloud:
    """Elements of a volume, shown as a ball each."""

    name: str  # e.g. tissue/femur
    radius_mm: float
    rgba: tuple[int, int, int, int]
    fixed: Array | None  # (n, 3) mm, world, of what does not move; None where a frame tells


@dataclass(frozen=True)
class Layout:
    """What a recording needs to know before the first frame."""

    #: Makes a frame of what a tick has copied, in any process: it can be pickled.
    frame: Callable[[Array], Frame]
    surfaces: tuple[Surface, ...]
    parts: tuple[InstrumentPart, ...]
    needle: Array | None  # (m, 3) mm centre line in the needle's own frame, tip first
    needle_radius_mm: float
    thread_radius_mm: float
    clouds: tuple[Cloud, ...] = ()
    #: Draws pictures (height, width, 3) uint8 of a frame, by name, in any process: it can be pickled; None where there
    #: is nothing to draw.
    pictures: Callable[[Frame], Mapping[str, np.ndarray]] | None = None
    #: Where the eye is and what it looks at, mm: on a stitch from above and the near side, as through a microscope.
    eye_mm: tuple[float, float, float] = (1.4, -4.8, 3.9)
    look_at_mm: tuple[float, float, float] = (0.15, 0.0, 0.75)


@dataclass(frozen=True)
class Frame:
    """What moves in a scene, at one tick, in the world."""

    vertices: tuple[Array, ...]  # per surface that is not fixed, (v, 3) mm, world
    part_position: Array  # (p, 3) mm, world_from_part
    part_quaternion: Array  # (p, 4) wxyz
    needle_position: Array | None  # (3,) world_from_needle
    needle_quaternion: Array | None  # (4,)
    thread: tuple[Array, ...]  # pieces of the thread, each (n, 3) mm; empty without thread
    force_mN: float  # largest force between instruments and tissue
    tension_mN: float  # thread
    clouds: tuple[Array, ...] = ()  # per cloud that is not fixed, (n, 3) mm, world


@dataclass(frozen=True)
class TickRecord:
    """One tick as the sinks see it."""

    tick: int
    time_s: float
    poses: ToolPoses
    events: tuple[Event, ...]
    snapshot: Callable[[], Array]  # copies what moves (k,), only when asked; the layout makes a frame of it


class Sink(Protocol):
    def tick(self, record: TickRecord) -> None: ...

    def close(self) -> None: ...
