"""The state that the rules of interaction share, and how a rule writes an event.

All of it is in the scene's own frame: where a teacher puts the scene in the world changes no bit of what happens in
it. Poses come in, and events, views and frames go out, in the frame of the world.

A component that the task does not ask for is None. Models are frozen; what changes lives here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trainer.anatomy.vessel import Ring, Tissue
from trainer.curriculum import Task
from trainer.events import Event
from trainer.geometry import Array, Rigid, fit_rotation
from trainer.instruments.needle import Needle
from trainer.interactions.region import Region
from trainer.mechanics.equilibrium import Equilibrium
from trainer.mechanics.quasi_newton import at_points
from trainer.mechanics.thread import ThreadModel
from trainer.mechanics.thread_drape import Drape


@dataclass(frozen=True)
class Place:
    """A material point of a wall: where it is in the mesh, and in the vessel's own coordinates."""

    vessel: int
    wall: str  # outer or inner
    nodes: np.ndarray  # (3,) int32, of the whole tissue
    weights: Array  # (3,)
    axial_mm: float
    clock: float  # rad
    ring: Ring  # of the outer wall around it


@dataclass
class TipContact:
    """The needle's tip pressing on a wall."""

    place: Place
    slot: int
    inwards: bool  # pressing towards the lumen
    stuck: bool  # False while the tip glides along the wall
    fraction: float  # of the movement at which it began, or 0 where it began earlier
    force_mN: float  # along the needle, or half of the whole if that is more; at the end of the last settled one
    normal: Array  # (3,) of the undented wall, at the end of the last movement


@dataclass(frozen=True)
class LastSeen:
    """Where the needle's tip was before it went a way that nobody saw."""

    tip: Array  # (3,) mm
    x: Array  # (n, 3) mm, the tissue's nodes then


@dataclass
class Hole:
    """A hole in a wall and what goes through it."""

    number: int
    place: Place
    slot: int
    inwards: bool  # the way the tip went
    pass_number: int
    normal: Array  # (3,) of the undented wall when it was pierced
    arc: float  # mm along needle and thread from the tip, of what is in the hole
    around: np.ndarray  # (k,) the triangles of the wall that touch it
    edge: tuple[np.ndarray, Array]  # the outer wall's cut edge at its hour: nodes (3,) and weights (3,)
    reached_mm: float = 0.0  # how far the tip got beyond the wall
    drawn_mm: float = 0.0  # how far what runs through it, towards the tip, has drawn the tissue along; bounded
    along: Array = field(default_factory=lambda: np.zeros(3))  # (3,) direction in which the thread runs through it
    open: bool = True  # False once needle and thread have left it, or it tore
    torn: bool = False


@dataclass
class Jaw:
    """One instrument's jaws and what they hold."""

    pose: Rigid
    closure: float
    seen: bool = True
    inside: bool = False  # whether its tip has gone through its portal
    lost_at: float = 0.0  # time at which the device last lost the instrument
    target: str = ""  # needle, thread, wall, tissue, or nothing
    since: int = 0  # order of grasping; who holds the needle longest leads it
    arc: float = 0.0  # along needle and thread from the tip
    lag_mm: float = 0.0  # thread that the tissue's equilibrium has yet to give to this grip
    tool_from_needle: Rigid | None = None
    vessel: int = -1
    wall: str = ""
    slots: tuple[int, ...] = ()
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))  # held wall, in the tool's frame


@dataclass
class Draping:
    """The thread's contact, and what of the last movement it needs in the next."""

    contact: Drape
    nodes: Array  # (n, 3) mm, the thread's when the movement began
    x: Array  # (n, 3) mm, the tissue's then
    blades: Array  # (2 k, 3) mm, the ends of the blades' axes then
    blades_now: Array
    points: dict[str, Array] = field(default_factory=dict)  # (3,) mm, where the thread was held then
    held_at: dict[str, Array] = field(default_factory=dict)  # (3,) mm, and where it is now
    detour: dict[tuple[str, str], float] = field(default_factory=dict)  # mm, from one constraint to the next
    lacks: bool = False  # whether a span drawn tight over something has yet to get the thread for it
    lying: dict[int, tuple[float, float]] = field(default_factory=dict)  # body → since, and last touched, s


@dataclass
class World:
    """Everything that a step reads and changes."""

    task: Task
    tools: tuple[str, ...]
    world_from_scene: Rigid
    scene_from_world: Rigid
    jaws: list[Jaw]
    tissue: Tissue | None = None
    solver: Equilibrium | None = None
    surface: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int32))  # (f, 3) triangles of all walls
    slit: np.ndarray = field(default_factory=lambda: np.zeros(0, np.bool_))  # (f,) which of them a tear has opened
    part: dict[tuple[int, str], tuple[int, int]] = field(default_factory=dict)  # (vessel, wall) → its rows of these
    needle: Needle | None = None
    needle_pose: Rigid = field(default_factory=Rigid.identity)
    thread: ThreadModel | None = None
    nodes: Array = field(default_factory=lambda: np.zeros((0, 3)))  # of the thread
    pieces: Array = field(default_factory=lambda: np.zeros((0, 2)))  # of the thread
    region: Region | None = None
    contact: TipContact | None = None
    last_seen: LastSeen | None = None  # while the tip is where it cannot have come without a hole
    touched: dict[tuple[int, str], float] = field(default_factory=dict)  # (vessel, wall) → time of the tip's last touch
    holes: list[Hole] = field(default_factory=list)
    passes: int = 0
    broken: bool = False  # the thread, in this session
    before: Array = field(default_factory=lambda: np.zeros((0, 3)))  # tissue before its last movement
    draping: Draping | None = None
    tension_mN: float = 0.0  # of the thread between two grips
    tissue_force_mN: float = 0.0  # largest force of an instrument on tissue in the last movement
    tick: int = 0
    over: set[str] = field(default_factory=set)  # limits exceeded at present
    events: list[Event] = field(default_factory=list)

    def emit(self, cls: type[Event], time_s: float, tool: str, **values: Any) -> None:
        """Write an event of this tick."""
        self.events.append(cls(tick=self.tick, seq=len(self.events), time_s=time_s, tool=tool, **values))

    def place_in_world(self, point: Array) -> tuple[float, float, float]:
        """A point (3,) mm of the scene as an event stores it."""
        return vector(self.world_from_scene.apply(point))

    def way_in_world(self, direction: Array) -> tuple[float, float, float]:
        """A direction (3,) of the scene as an event stores it."""
        return vector(self.world_from_scene.rotate(direction))

    def wall(self, vessel: int, wall: str) -> np.ndarray:
        """The triangles (f, 3) of one wall, without those that a tear has opened."""
        first, last = self.part[vessel, wall]
        triangles, slit = self.surface[first:last], self.slit[first:last]
        return triangles[~slit] if slit.any() else triangles

    def wall_of(self, triangle: int) -> tuple[int, str]:
        """The vessel and the wall that a triangle of ``surface`` belongs to."""
        return next(at for at, (first, last) in self.part.items() if first <= triangle < last)

    def open_holes(self) -> list[Hole]:
        return [h for h in self.holes if h.open]

    def point(self, place: Place) -> Array:
        """Where a material point is now (3,) mm."""
        assert self.solver is not None
        where = np.empty((1, 3))
        at_points(self.solver.x, place.nodes[None], place.weights[None], where)
        return np.asarray(where[0])

    def points(self, holes: list[Hole]) -> list[list[float]]:
        """Where the material points of open ``holes`` are now, mm."""
        if not holes:
            return []
        assert self.solver is not None
        found: list[list[float]] = self.solver.positions([hole.slot for hole in holes]).tolist()
        return found

    def vessel_name(self, place: Place) -> str:
        assert self.tissue is not None
        return self.tissue.vessels[place.vessel].spec.name

    def undented(self, place: Place) -> tuple[Array, Array]:
        """The outward normal (3,) and the outer surface's point (3,) mm that the wall would have without its dent.

        Both are carried from rest by the rigid motion that fits the ring of wall around the place best.
        """
        assert self.tissue is not None and self.solver is not None
        vessel = self.tissue.vessels[place.vessel]
        ring = place.ring
        now = self.solver.x[self.tissue.nodes(place.vessel)][ring.nodes]
        rotation = fit_rotation(ring.rest, now)
        surface = (
            np.asarray(vessel.spec.cut_edge_mm) + place.axial_mm * vessel.axis + vessel.outer_radius_mm * ring.radial
        )
        return rotation @ ring.radial, rotation @ (surface - ring.rest.mean(axis=0)) + now.mean(axis=0)

    def needle_tool(self) -> int | None:
        """The instrument that leads the needle: of those that hold it, the one that grasped first."""
        holders = [i for i, j in enumerate(self.jaws) if j.target == "needle"]
        return min(holders, key=lambda i: self.jaws[i].since) if holders else None


def vector(a: Array) -> tuple[float, float, float]:
    """An array (3,) as an event stores it."""
    return (float(a[0]), float(a[1]), float(a[2]))
