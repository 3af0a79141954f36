"""What a trainee sees of the world: the scene's side of :mod:`trainer.view`."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from trainer.anatomy import vessel as vessels
from trainer.geometry import Array, Rigid
from trainer.interactions import goal, sight, thread_pull
from trainer.interactions.world import World
from trainer.poses import ToolPoses
from trainer.view import HoleView, View


class SceneView(View):
    """A view of the ``world``: most ticks need little of it, so that each part waits until it is asked for."""

    def __init__(self, world: World, tick: int, steps_done: int, vessel_axis: dict[str, Array]) -> None:
        self._world = world
        self.tick = tick
        self.time_s = tick / world.task.tick_hz
        self.steps_done = steps_done
        self.vessel_axis = vessel_axis

    def look(self, vessel: str, clock_deg: float, axial_mm: float, hull: str) -> tuple[Array, Array]:
        world = self._world
        assert world.tissue is not None
        assert world.solver is not None
        index = next(i for i, v in enumerate(world.tissue.vessels) if v.spec.name == vessel)
        v = world.tissue.vessels[index]
        x = world.solver.x[world.tissue.nodes(index)]
        clock = math.radians(clock_deg)
        nodes, weights = vessels.wall_point(v, clock, axial_mm, "inner" if hull == "inner" else "outer")
        out = world.world_from_scene
        return out.apply(weights @ x[nodes]), out.rotate(vessels.undented_normal(v, x, clock, axial_mm))

    @cached_property
    def poses(self) -> ToolPoses:
        return poses(self._world)

    @cached_property
    def world_from_needle(self) -> Rigid | None:
        world = self._world
        return world.world_from_scene @ world.needle_pose if world.needle is not None else None

    @cached_property
    def needle_holders(self) -> tuple[int, ...]:
        jaws = self._world.jaws
        return tuple(sorted((i for i, j in enumerate(jaws) if j.target == "needle"), key=lambda i: jaws[i].since))

    @cached_property
    def thread_holders(self) -> tuple[int, ...]:
        return tuple(i for i, j in enumerate(self._world.jaws) if j.target == "thread")

    @cached_property
    def holes(self) -> tuple[HoleView, ...]:
        world = self._world
        return tuple(
            HoleView(
                vessel=world.vessel_name(h.place),
                wall=h.place.wall,
                direction="in" if h.inwards else "out",
                point=world.world_from_scene.apply(world.point(h.place)),
                arc_mm=h.arc,
            )
            for h in world.open_holes()
        )

    @cached_property
    def thread(self) -> Array | None:
        world = self._world
        return world.world_from_scene.apply(world.nodes) if world.thread is not None else None

    @cached_property
    def tail_mm(self) -> float:
        return thread_pull.tail_mm(self._world)

    @cached_property
    def gap_mm(self) -> float:
        return goal.gap_mm(self._world)

    def place(self, place_mm: Array) -> Array:
        return self._world.world_from_scene.apply(place_mm)

    def tissue(self, structure: str, place_mm: Array) -> Array:
        world = self._world
        assert world.region is not None
        elements = world.region.elements[structure]
        away = np.linalg.norm(world.region.rest(elements) - place_mm, axis=1)
        return world.world_from_scene.apply(world.region.places(elements[[np.argmin(away)]])[0])

    def uncut(self, structure: str, place_mm: Array) -> Array:
        world = self._world
        assert world.region is not None
        return world.world_from_scene.apply(world.region.places(sight.uncut_at(world.region, structure, place_mm)))

    def free_mm(self, place: Array, way: Array, most_mm: float) -> float:
        world = self._world
        assert world.region is not None
        inwards = world.scene_from_world
        return sight.free_mm(world.region, inwards.apply(place), inwards.rotate(way), most_mm)

    def in_sight(self, structure: str, eye: Array) -> Array | None:
        world = self._world
        assert world.region is not None
        place = sight.in_sight(world.region, structure, world.scene_from_world.apply(eye))
        return None if place is None else world.world_from_scene.apply(place)

    def touched(self, tool: int) -> str:
        assert self._world.region is not None
        return self._world.region.inside[tool]

    @cached_property
    def tissue_holders(self) -> tuple[int, ...]:
        return tuple(i for i, j in enumerate(self._world.jaws) if j.target == "tissue")


def poses(world: World) -> ToolPoses:
    """Where the instruments are, in the world."""
    placed = [world.world_from_scene @ jaw.pose for jaw in world.jaws]
    return ToolPoses(
        np.array([pose.position for pose in placed]),
        np.array([pose.quaternion for pose in placed]),
        np.array([jaw.closure for jaw in world.jaws]),
        np.array([jaw.seen for jaw in world.jaws]),
    )
