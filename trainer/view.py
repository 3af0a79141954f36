"""What a trainee sees of the scene at one tick; scripted hands look at it to decide how to move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from trainer.geometry import Array, Rigid
from trainer.poses import ToolPoses

#: (vessel, clock_deg, axial_mm, hull) → the point of the wall now (3,) mm, and its undented outward normal (3,).
Look = Callable[[str, float, float, str], tuple[Array, Array]]


@dataclass(frozen=True)
class HoleView:
    """A hole that needle or thread goes through."""

    vessel: str
    wall: str  # outer or inner
    direction: str  # in or out
    point: Array  # (3,) mm, where it is now
    arc_mm: float  # what is in it: distance along needle and thread from the needle's tip


@dataclass(frozen=True)
class View:
    """Plain values; ``look`` answers where a marked place of a wall is at this tick."""

    tick: int
    time_s: float
    poses: ToolPoses  # where the instruments are
    look: Look
    vessel_axis: dict[str, Array]  # from the cut into the end (3,), at rest
    world_from_needle: Rigid | None
    needle_holders: tuple[int, ...]  # instruments that hold the needle
    thread_holders: tuple[int, ...]  # instruments that hold the thread
    holes: tuple[HoleView, ...]
    thread: Array | None  # (n, 3) mm nodes, from the needle to the free end
    tail_mm: float  # thread left before the first hole
    gap_mm: float  # between the edges at the stitch
    steps_done: int  # of the task
