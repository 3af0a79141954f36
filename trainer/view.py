"""What a trainee sees of the scene at one tick; scripted hands look at it to decide how to move."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from trainer.geometry import Array, Rigid
from trainer.poses import ToolPoses


@dataclass(frozen=True)
class HoleView:
    """A hole that needle or thread goes through."""

    vessel: str
    wall: str  # outer or inner
    direction: str  # in or out
    point: Array  # (3,) mm, where it is now
    arc_mm: float  # what is in it: distance along needle and thread from the needle's tip


class View(ABC):
    """The scene as it is now, each thing worked out when it is looked at: to be read before the scene moves on."""

    tick: int
    time_s: float
    steps_done: int  # of the task
    vessel_axis: dict[str, Array]  # from the cut into the end (3,), at rest

    @abstractmethod
    def look(self, vessel: str, clock_deg: float, axial_mm: float, hull: str) -> tuple[Array, Array]:
        """Where a marked place of a wall is (3,) mm, and its undented outward normal (3,)."""

    @property
    @abstractmethod
    def poses(self) -> ToolPoses:
        """Where the instruments are."""

    @property
    @abstractmethod
    def world_from_needle(self) -> Rigid | None: ...

    @property
    @abstractmethod
    def needle_holders(self) -> tuple[int, ...]:
        """The instruments that hold the needle, who took it first before the others."""

    @property
    @abstractmethod
    def thread_holders(self) -> tuple[int, ...]:
        """The instruments that hold the thread."""

    @property
    @abstractmethod
    def holes(self) -> tuple[HoleView, ...]:
        """The holes that needle or thread goes through."""

    @property
    @abstractmethod
    def thread(self) -> Array | None:
        """Nodes (n, 3) mm, from the needle to the free end."""

    @property
    @abstractmethod
    def tail_mm(self) -> float:
        """Thread left before the first hole."""

    @property
    @abstractmethod
    def gap_mm(self) -> float:
        """Between the edges at the stitch."""

    @abstractmethod
    def place(self, place_mm: Array) -> Array:
        """Where a place (3,) mm of the scene is in the world."""

    @abstractmethod
    def tissue(self, structure: str, place_mm: Array) -> Array:
        """Where the element of a structure is (3,) mm that is nearest to ``place_mm`` of the scene at rest."""

    @abstractmethod
    def uncut(self, structure: str, place_mm: Array) -> Array:
        """Where the elements (k, 3) mm of a structure are that no cut near ``place_mm`` of the scene has met.

        Where there are none, those by which the structure holds together still.
        """

    @abstractmethod
    def free_mm(self, place: Array, way: Array, most_mm: float) -> float:
        """How far a tip may go from ``place`` (3,) along the unit vector ``way`` (3,) and meet nothing rigid."""

    @abstractmethod
    def in_sight(self, structure: str, eye: Array) -> Array | None:
        """The nearest place of a structure (3,) mm that a straight free way leads to from ``eye`` (3,); or None."""

    @abstractmethod
    def touched(self, tool: int) -> str:
        """The structure that the tip of a probe touches, or ""."""

    @property
    @abstractmethod
    def tissue_holders(self) -> tuple[int, ...]:
        """The instruments that hold tissue of a volume."""
