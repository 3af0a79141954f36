"""Handling a volume of tissue: grasp, pull, tack, cut, tear, touch (Gibson et al. 1998, sections 3.2 to 3.4).

In each movement what jaws hold is put where they are, the rest follows as far as its links ask (ChainMail), links that
nothing can satisfy tear, and the tissue relaxes. What is held is fixed meanwhile; so is what is tacked.
"""

from __future__ import annotations

import numpy as np

from trainer.curriculum import InstrumentSpec
from trainer.events import Cut, Grasp, Probe, Release, Slip, Tack, Tear
from trainer.geometry import Array
from trainer.instruments.arthroscopic import edges
from trainer.interactions import giving_way, grasp, portal, probing
from trainer.interactions.region import LOOSE, Hold, Region
from trainer.interactions.world import World
from trainer.mechanics.elastic_relaxation import force_on, relax
from trainer.mechanics.incision import cut, tear
from trainer.mechanics.volume import Indices, tack, untack
from trainer.mechanics.volume_drag import drag

#: Blades turn round when their closure has come back by so much: 2 degrees of the 45 between them, ten counts of a
#: closure sensor of eight bits. Assumed.
DEAD_BAND = 0.05


def move(world: World, closures: Array, start_s: float, span_s: float) -> None:
    """One movement of the region under the instruments, whose jaws go to ``closures`` (k,)."""
    region = world.region
    if region is None:
        return
    end_s = start_s + span_s
    world.tissue_force_mN = 0.0
    for i, spec in enumerate(world.task.scene.instrument):
        portal.pivot(world, i, end_s)
        if spec.kind == "grasper":
            _close_and_open(world, region, i, spec, float(closures[i]), end_s)
        elif spec.kind == "scissors":
            _snip(world, region, i, float(closures[i]), end_s)
        elif spec.kind == "probe":
            probing.push(world, region, i)
    for i, hold in enumerate(region.held):
        if hold is not None:
            _lead(world, region, i, hold)
    _keep_limits_at_tacks(region)
    _tear(world, region, end_s)
    relax(region.volume, region.state, span_s)
    _judge_pulls(world, region, end_s)
    for i, spec in enumerate(world.task.scene.instrument):
        if spec.kind == "probe":
            probing.feel(world, region, i, end_s)
        else:
            _touch(world, region, i, end_s)


def _close_and_open(
    world: World, region: Region, tool: int, spec: InstrumentSpec, closure: float, time_s: float
) -> None:
    """Take hold of tissue, tack it and let go of it, as the jaws close and open."""
    before = world.jaws[tool].closure
    hold = region.held[tool]
    if hold is None and before < spec.close_at <= closure:
        _catch(world, region, tool, spec, time_s)
    elif hold is not None and closure < spec.open_at:
        let_go(world, region, tool)
        world.emit(Release, time_s, world.tools[tool], target="tissue", body=hold.structure)
    elif hold is not None and spec.tack_at is not None and before < spec.tack_at <= closure:
        hold.tacked = True
        region.tacked[hold.elements] = True
        world.emit(
            Tack, time_s, world.tools[tool], body=hold.structure,
            point=world.place_in_world(region.places(hold.elements).mean(axis=0)),
            volume_mm3=region.mm3(hold.elements), force_mN=hold.pull_mN,
        )  # fmt: skip


def _catch(world: World, region: Region, tool: int, spec: InstrumentSpec, time_s: float) -> None:
    """Hold what lies within reach of the jaws' centre, of the structure that is nearest. A tack in it comes out."""
    pose = region.in_layer(world.jaws[tool].pose)
    nearest: tuple[float, str, Indices] | None = None
    others = [h.elements for h in region.held if h is not None]
    taken = np.concatenate(others) if others else np.empty(0, np.int32)
    for structure, elements in region.elements.items():
        there = elements[((region.state.links[elements] & LOOSE) == LOOSE) | region.tacked[elements]]
        there = np.setdiff1d(there, taken)
        away = np.linalg.norm(region.places(there) - pose.position, axis=1)
        within = away <= spec.reach_mm
        if within.any() and (nearest is None or away.min() < nearest[0]):
            nearest = (float(away.min()), structure, there[within].astype(np.int32))
    if nearest is None:
        return
    _, structure, caught = nearest
    region.tacked[caught] = False
    tack(region.state, caught)
    region.held[tool] = Hold(structure, caught, pose.inverse().apply(region.places(caught)))
    world.jaws[tool].target = "tissue"
    world.emit(
        Grasp, time_s, world.tools[tool], target="tissue", body=structure, arc_mm=0.0,
        point=world.place_in_world(region.rest(caught).mean(axis=0)), force_mN=spec.grip_mN.value,
    )  # fmt: skip


def let_go(world: World, region: Region, tool: int) -> None:
    """Empty the jaws; what was tacked stays where it is."""
    hold = region.held[tool]
    if hold is not None:
        untack(region.volume, region.state, hold.elements[~region.tacked[hold.elements]])
    region.held[tool] = None
    world.jaws[tool].target = ""


def _lead(world: World, region: Region, tool: int, hold: Hold) -> None:
    """Put what the jaws hold where they are; in one layer it stays in the layer."""
    to = region.in_layer(world.jaws[tool].pose).apply(hold.points) - region.rest(hold.elements)
    if region.flat >= 0:
        to[:, region.flat] = 0.0
    if (to.astype(np.float32) != region.state.u[:, hold.elements].T).any():
        drag(region.volume, region.state, hold.elements, to)


def _keep_limits_at_tacks(region: Region) -> None:
    """Relaxation asks for no limits; beside what is held the next drag restores them, beside a tack nobody would."""
    held = [h.elements for h in region.held if h is not None]
    tacked = np.flatnonzero(region.tacked).astype(np.int32)
    tacked = np.setdiff1d(tacked, np.concatenate(held)) if held else tacked
    if len(tacked) and region.state.awake is not None:
        drag(region.volume, region.state, tacked, region.state.u[:, tacked].T)


def _snip(world: World, region: Region, tool: int, closure: float, time_s: float) -> None:
    """Blades that close cut what lies between them, from where they began to close on.

    One stroke lasts until they have opened by DEAD_BAND: a sample that comes twice, or trembles, neither ends nor
    begins one.
    """
    blades, jaw = region.blades[tool], world.jaws[tool]
    if blades.closing and closure < blades.closure - DEAD_BAND:
        _end_stroke(world, region, tool, time_s)
        blades.closing, blades.closure = False, closure
    elif not blades.closing and closure <= blades.closure + DEAD_BAND:
        blades.closure = min(blades.closure, closure)
    elif closure > blades.closure:
        pose = region.in_layer(jaw.pose)
        for before, after in zip(edges(pose, blades.closure), edges(pose, closure), strict=True):
            change = cut(region.volume, region.state, before - region.origin, after - region.origin)
            for structure, lost in region.note(change).items():
                blades.cut.setdefault(structure, []).append(lost)
        blades.closing, blades.closure = True, closure
        if closure == 1.0:
            _end_stroke(world, region, tool, time_s)


def end_strokes(world: World, time_s: float) -> None:
    """Write what was cut by blades that are still closing: the exercise is over."""
    if world.region is not None:
        for i in range(len(world.tools)):
            _end_stroke(world, world.region, i, time_s)


def _end_stroke(world: World, region: Region, tool: int, time_s: float) -> None:
    for structure, pieces in region.blades[tool].cut.items():
        lost = np.unique(np.concatenate(pieces))
        world.emit(
            Cut, time_s, world.tools[tool], body=structure,
            point=world.place_in_world(region.rest(lost).mean(axis=0)), volume_mm3=region.mm3(lost),
        )  # fmt: skip
    region.blades[tool].cut.clear()


def _tear(world: World, region: Region, time_s: float) -> None:
    """Links that no movement can satisfy any more break."""
    whole = region.tissue.keys() - region.severed
    for structure, lost in region.note(tear(region.volume, region.state)).items():
        if structure in whole & region.severed:
            region.torn_through = region.torn_through or structure
        world.emit(
            Tear, time_s, "", body=structure, wall="", hole=-1,
            point=world.place_in_world(region.places(lost).mean(axis=0)),
            force_mN=max((h.pull_mN for h in region.held if h is not None), default=0.0), limit_mN=0.0,
            volume_mm3=region.mm3(lost),
        )  # fmt: skip


def _judge_pulls(world: World, region: Region, time_s: float) -> None:
    """What is pulled harder than jaws can hold slips out of them; a pull above the task's limit is told."""
    for i, hold in enumerate(region.held):
        if hold is None:
            continue
        hold.pull_mN = float(np.linalg.norm(force_on(region.volume, region.state, hold.elements)))
        region.pull_max_mN = max(region.pull_max_mN, hold.pull_mN)
        spec = world.task.scene.instrument[i]
        limit = grasp.capacity_mN(world, i)
        # Jaws that are being opened let go; nothing slips out of them.
        if world.jaws[i].closure >= spec.close_at and hold.pull_mN > limit:
            let_go(world, region, i)
            world.emit(
                Slip, time_s, world.tools[i], target="tissue", body=hold.structure, load_mN=hold.pull_mN, limit_mN=limit
            )
    pull = max((h.pull_mN for h in region.held if h is not None), default=0.0)
    world.tissue_force_mN = max(world.tissue_force_mN, pull)
    giving_way.check_limit(world, "tissue_pull", pull, "", "", time_s)


def _touch(world: World, region: Region, tool: int, time_s: float) -> None:
    """Tell when the tip of an instrument goes into something rigid."""
    tip = region.in_layer(world.jaws[tool].pose).position
    found = region.structure_at(tip)
    found = "" if found in region.elements else found
    if found and found != region.inside[tool]:
        world.emit(Probe, time_s, world.tools[tool], body=found, point=world.place_in_world(tip))
    region.inside[tool] = found
