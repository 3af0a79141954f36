"""A scene: the components that a task asks for, and one step of all of them.

``build`` makes it from a task, ``step`` moves it by one tick under given instrument poses and tells what
happened. A step is a function of task, tolerance, state and poses alone: it reads no clock and draws no random number.
"""

from __future__ import annotations

import itertools
import math
from types import ModuleType
from typing import Any

import numpy as np

from trainer import scene_rules, showing, snapshot
from trainer.anatomy import vessel as vessels
from trainer.anatomy.imported import Anatomy
from trainer.config import ConfigError
from trainer.curriculum import Task
from trainer.events import Aborted, Event, StepDone, TaskDone, TaskStarted, TrackingBack, TrackingLost
from trainer.geometry import Array, Rigid, quaternion_from_axes, quaternion_from_euler_deg, slerp, unit
from trainer.instruments import arthroscopic, forceps, probe
from trainer.instruments.needle import Needle, needle_point, needle_tangent
from trainer.interactions import (
    drape,
    giving_way,
    goal,
    grasp,
    holding,
    pierce,
    region,
    seeing,
    thread_pull,
    tissue_handling,
    unseen,
)
from trainer.interactions.world import Jaw, World
from trainer.mechanics.equilibrium import Equilibrium
from trainer.mechanics.thread import ThreadModel
from trainer.poses import ToolPoses
from trainer.sinks.surface import InstrumentPart, Layout, Surface
from trainer.view import View

#: A tick in which an instrument or the needle's tip moves further than this is taken in several movements, mm.
STRIDE_MM = 0.1
#: In a region of the anatomy so much of a voxel is a stride: nothing there is finer.
STRIDE_VOXELS = 0.25
#: … but in no more than this many: beyond 1.6 mm in a tick of 10 ms the motion is a leap of the tracker.
MOST_MOVEMENTS = 16


def build(task: Task, tolerance_mN: float = holding.TOLERANCE_MN, anatomy: Anatomy | None = None) -> Scene:
    """The scene at rest, with the instruments at home and the needle where the task has it held.

    ``tolerance_mN`` is the unbalanced force at which the tissue counts as in equilibrium; ``anatomy`` the knee to
    practise on, where that is not the task's own. Raises ConfigError for an anatomy that the task cannot use, and for
    things that lie where it cannot be practised.
    """
    spec = task.scene
    world_from_scene = Rigid(np.array(spec.position_mm), quaternion_from_euler_deg(spec.rotation_deg))
    homes = [Rigid(np.array(i.home_mm), quaternion_from_euler_deg(i.home_rotation_deg)) for i in spec.instrument]
    world = World(
        task=task,
        tools=tuple(i.tool for i in spec.instrument),
        world_from_scene=world_from_scene,
        scene_from_world=world_from_scene.inverse(),
        jaws=[Jaw(pose=h, closure=0.0) for h in homes],
    )
    if spec.vessel:
        tissue = vessels.together(tuple(vessels.build(v) for v in spec.vessel))
        world.tissue = tissue
        world.solver = Equilibrium(tissue.mesh, tissue.orders())
        world.before = world.solver.x.copy()
        walls = [
            (v, wall, (triangles + tissue.offset[v]).astype(np.int32))
            for v, vessel in enumerate(tissue.vessels)
            for wall, triangles in (("outer", vessel.outer_triangles), ("inner", vessel.inner_triangles))
        ]
        world.surface = np.concatenate([triangles for _, _, triangles in walls])
        world.slit = np.zeros(len(world.surface), dtype=np.bool_)
        ends = itertools.accumulate(len(triangles) for _, _, triangles in walls)
        world.part = {(v, wall): (end - len(t), end) for (v, wall, t), end in zip(walls, ends, strict=True)}
    if spec.needle is not None:
        world.needle = Needle(spec.needle.length_mm / math.radians(spec.needle.arc_deg), spec.needle.length_mm)
        _hand_over_needle(world)
    if spec.thread is not None and world.needle is not None:
        count = round(spec.thread.length_mm / spec.thread.link_mm) + 1
        world.thread = ThreadModel(world.needle.length, spec.thread.link_mm, count)
        world.pieces = world.thread.whole()
        # The thread lies straight behind the needle.
        back = -world.needle_pose.rotate(needle_tangent(world.needle, world.needle.length))
        along = spec.thread.link_mm * np.arange(count)
        world.nodes = thread_pull.swage(world) + along[:, None] * back
        if spec.thread.drapes:
            drape.begin(world)
    try:
        if spec.anatomy is not None:
            world.region = region.build(task, spec.anatomy, anatomy)
        scene_rules.check(world)
    except ConfigError as error:
        raise ConfigError(f"task '{task.name}': {error}") from None
    return Scene(world, tolerance_mN)


def _hand_over_needle(world: World) -> None:
    """Put the needle into the jaws of the instrument that holds it when the exercise begins.

    The jaws point at the circle's centre and hold the wire across; without a holder the needle lies at the origin.
    """
    spec, needle = world.task.scene.needle, world.needle
    assert spec is not None and needle is not None
    if not spec.held_by:
        return
    tool = world.tools.index(spec.held_by)
    arc = spec.held_at * needle.length
    phi = arc / needle.radius
    inward = np.array([math.sin(phi), math.cos(phi), 0.0])
    needle_from_tool = Rigid(needle_point(needle, arc), quaternion_from_axes(inward, np.array([0.0, 0.0, 1.0])))
    jaw = world.jaws[tool]
    jaw.closure = 1.0
    world.needle_pose = jaw.pose @ needle_from_tool.inverse()
    grasp.hold_needle(world, tool, arc)


class Scene:
    """State of one exercise; see :mod:`trainer.interactions.world` for what is in it."""

    def __init__(self, world: World, tolerance_mN: float) -> None:
        self.world = world
        self.tolerance_mN = tolerance_mN
        self.tools = world.tools
        self.outcome = ""  # completed, failed, aborted or timeout; empty while it runs
        self.reason = ""
        self.tick = 0
        self.home = seeing.poses(world)
        self._axes = {v.spec.name: world.world_from_scene.rotate(v.axis) for v in self._vessels()}
        self.steps_done = 0
        self._passes_used: set[int] = set()

    def step(self, poses: ToolPoses) -> tuple[Event, ...]:
        """One tick: instruments go to ``poses``, tissue and thread follow, rules are judged.

        Raises ValueError for another number of instruments than the task has. Poses must be finite.
        """
        world, task = self.world, self.world.task
        if len(poses.closure) != len(self.tools):
            raise ValueError(f"{len(self.tools)} instruments need {len(self.tools)} poses, found {len(poses.closure)}")
        dt = 1.0 / task.tick_hz
        start_s = self.tick * dt
        world.tick, world.events = self.tick, []
        if self.tick == 0:
            world.emit(TaskStarted, 0.0, "", task=task.name)
            grasp.report_held(world, 0.0)
        seen_before = [j.seen for j in world.jaws]
        targets, closures = self._tracked(poses, start_s)
        unseen.watch(world, seen_before, targets)
        starts, from_closures = [j.pose for j in world.jaws], np.array([j.closure for j in world.jaws])
        movements = self._movements(starts, targets)
        for m in range(movements):
            share = (m + 1) / movements
            at = [_part_way(a, b, share) for a, b in zip(starts, targets, strict=True)]
            jaws = from_closures + share * (closures - from_closures)
            self._move(at, jaws, start_s + m / movements * dt, dt / movements)
            if world.broken:
                break
        unseen.find(world)
        self._judge(start_s + dt)
        self.tick += 1
        return tuple(world.events)

    def finish(self, outcome: str, reason: str) -> tuple[Event, ...]:
        """End the exercise from outside: the input ended, or the trainee stopped."""
        world = self.world
        world.tick, world.events = self.tick, []
        if outcome == "aborted":
            world.emit(Aborted, self.tick / world.task.tick_hz, "", reason=reason)
        self._end(outcome, reason, self.tick / world.task.tick_hz)
        return tuple(world.events)

    def _tracked(self, poses: ToolPoses, time_s: float) -> tuple[list[Rigid], Array]:
        """Where the instruments go: one that the device lost stays, jaws and all."""
        world = self.world
        targets, closures = [], np.zeros(len(self.tools))
        for i, jaw in enumerate(world.jaws):
            seen = bool(poses.valid[i])
            if seen != jaw.seen:
                jaw.seen = seen
                if seen:
                    world.emit(TrackingBack, time_s, self.tools[i], lost_s=time_s - jaw.lost_at)
                else:
                    jaw.lost_at = time_s
                    world.emit(TrackingLost, time_s, self.tools[i], reason=poses.why_lost(i))
            targets.append(world.scene_from_world @ poses.world_from_tool(i) if seen else jaw.pose)
            closures[i] = poses.closure[i] if seen else jaw.closure
        return targets, closures

    def _movements(self, starts: list[Rigid], targets: list[Rigid]) -> int:
        """Into how many movements this tick is divided, so that none is longer than a stride."""
        farthest = 0.0
        for i, (a, b) in enumerate(zip(starts, targets, strict=True)):
            farthest = max(farthest, math.dist(a.position, b.position))
            held = self.world.jaws[i].tool_from_needle
            if held is not None:
                farthest = max(farthest, math.dist(a.apply(held.position), b.apply(held.position)))
        region = self.world.region
        stride = STRIDE_MM if region is None else STRIDE_VOXELS * min(region.volume.spacing_mm)
        return min(MOST_MOVEMENTS, max(1, math.ceil(farthest / stride)))

    def _move(self, poses: list[Rigid], closures: Array, start_s: float, span_s: float) -> None:
        """One movement of all instruments, from ``start_s`` to ``start_s + span_s``."""
        world = self.world
        end_s = start_s + span_s
        for jaw, pose in zip(world.jaws, poses, strict=True):
            jaw.pose = pose
        before = world.needle_pose
        tool = self._lead_needle()
        tissue_handling.move(world, closures, start_s, span_s)
        grasp.close_and_open(world, closures, end_s)
        grasp.second_grips(world, end_s)
        if world.needle is not None and tool:
            pierce.detect(world, before, world.needle_pose, start_s, span_s, tool)
            pierce.glide(world)
        holding.equilibrate(world, before, start_s, span_s, tool, self.tolerance_mN)
        pierce.follow_needle(world, end_s, tool)
        slack = giving_way.relieve(world, end_s)
        thread_pull.settle(world, end_s, slack)
        drape.tell(world, end_s)

    def _lead_needle(self) -> str:
        """Move the needle with the instrument that holds it; its name, or "" when none does."""
        world = self.world
        leader = world.needle_tool()
        if leader is None:
            return ""
        held = world.jaws[leader].tool_from_needle
        assert held is not None
        world.needle_pose = world.jaws[leader].pose @ held
        return self.tools[leader]

    def _judge(self, time_s: float) -> None:
        world, task = self.world, self.world.task
        if world.broken:
            self._end("failed", "the thread broke", time_s)
            return
        if world.region is not None and world.region.torn_through:
            self._end("failed", f"the {world.region.torn_through} tore through", time_s)
            return
        while self.steps_done < len(task.step):
            step = task.step[self.steps_done]
            if not goal.reached(world, step, self._passes_used):
                break
            world.emit(StepDone, time_s, "", step=step.name, index=self.steps_done)
            self.steps_done += 1
        if self.steps_done == len(task.step):
            self._end("completed", "every step was reached", time_s)
        elif time_s >= task.time_limit_s - 0.5 / task.tick_hz:
            self._end("timeout", f"the time limit of {task.time_limit_s:g} s", time_s)

    def _end(self, outcome: str, reason: str, time_s: float) -> None:
        world = self.world
        self.outcome, self.reason = outcome, reason
        tissue_handling.end_strokes(world, time_s)
        world.emit(
            TaskDone, time_s, "", outcome=outcome, reason=reason,
            needle_tip=world.place_in_world(world.needle_pose.position),
            needle_tangent=world.way_in_world(world.needle_pose.rotate(np.array([1.0, 0.0, 0.0]))),
            thread_end=world.place_in_world(world.nodes[-1]) if world.thread is not None else (0.0, 0.0, 0.0),
            thread_length_error=thread_pull.stretch(world), tail_mm=thread_pull.tail_mm(world),
            gap_mm=goal.gap_mm(world), pull_max_mN=world.region.pull_max_mN if world.region is not None else 0.0,
            press_max_mN=world.region.press_max_mN if world.region is not None else 0.0,
        )  # fmt: skip

    def view(self) -> View:
        """What a trainee sees now."""
        return seeing.SceneView(self.world, self.tick, self.steps_done, self._axes)

    def layout(self) -> Layout:
        """What does not change during the exercise, for a recording."""
        world = self.world
        scene = world.task.scene
        blades = [_shape(i.kind).parts() for i in scene.instrument]
        reader = snapshot.Reader(
            world.world_from_scene,
            part_poses=tuple(_shape(i.kind).part_poses for i in scene.instrument),
            needle=world.needle is not None,
            vessels=tuple(len(v.mesh.rest) for v in self._vessels()),
            clouds=tuple(map(len, self._clouds())),
            thread=world.thread,
        )
        return Layout(
            frame=reader.frame,
            surfaces=tuple(
                Surface(f"vessel/{v.spec.name}", v.display_triangles, (226, 120, 110, 205)) for v in self._vessels()
            )
            + (showing.surfaces(world.region, world.world_from_scene) if world.region is not None else ()),
            parts=tuple(
                InstrumentPart(f"{tool}/{blade.name}", i, blade.vertices, blade.triangles)
                for i, tool in enumerate(self.tools)
                for blade in blades[i]
            ),
            needle=(
                np.array([needle_point(world.needle, s) for s in np.linspace(0.0, world.needle.length, 33)])
                if world.needle is not None
                else None
            ),
            needle_radius_mm=0.5 * scene.needle.wire_mm if scene.needle else 0.0,
            thread_radius_mm=0.5 * scene.thread.diameter_mm.value if scene.thread else 0.0,
            clouds=showing.clouds(world.region, world.world_from_scene) if world.region is not None else (),
            **_looks(world),
        )

    def snapshot(self) -> Array:
        """A copy of everything that moves (k,), for the ``frame`` of :meth:`layout`."""
        world = self.world
        held = thread_pull.constraints(world) if world.thread is not None else None
        return snapshot.copy(world, held, self._clouds())

    def _clouds(self) -> tuple[Array, ...]:
        return showing.moving(self.world.region) if self.world.region is not None else ()

    def _vessels(self) -> tuple[vessels.Vessel, ...]:
        return self.world.tissue.vessels if self.world.tissue is not None else ()


def _shape(kind: str) -> ModuleType:
    """The module that says what an instrument looks like."""
    return {"forceps": forceps, "probe": probe}.get(kind, arthroscopic)


def _part_way(a: Rigid, b: Rigid, share: float) -> Rigid:
    if share == 1.0:
        return b
    return Rigid(a.position + share * (b.position - a.position), slerp(a.quaternion, b.quaternion, share))


def _looks(world: World) -> dict[str, Any]:
    """Where a recording looks from, and what draws its pictures: a section is seen from the front of its z, a block
    from the side on which the instruments wait."""
    region = world.region
    if region is None:
        return {}
    home = np.mean([i.home_mm for i in world.task.scene.instrument], axis=0)
    # Not straight down: the recording's view has +z up.
    towards = np.array([0.0, -0.25, 1.0]) if region.flat >= 0 else unit(home)
    eye, middle = showing.eye(region, towards)
    return {
        "eye_mm": world.place_in_world(eye),
        "look_at_mm": world.place_in_world(middle),
        "pictures": showing.pictures(region, world.scene_from_world, towards),
    }
