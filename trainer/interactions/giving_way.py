"""What gives way under the forces of an equilibrium: walls tear, grips slip, the thread breaks, limits are exceeded."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainer.events import Overforce, Tear
from trainer.geometry import Array, length
from trainer.interactions import grasp, pierce, tearing, thread_pull
from trainer.interactions.world import Hole, World
from trainer.mechanics.attachments import Anchors, Cable
from trainer.mechanics.equilibrium import Result

#: Forces are judged when what is left unbalanced is below this share of them; else the next movement goes on first.
SETTLED = 0.1
#: An exceeded limit counts again once the value has fallen below this share of it.
REARM = 0.9


@dataclass(frozen=True)
class Grips:
    """Who holds the tissue where: row by row the anchors of one solve."""

    anchors: Anchors
    owner: tuple[Hole | int | None, ...]  # a hole on the needle, an instrument, or None for the needle's tip


def settled(found: Result, force_mN: float) -> bool:
    """Whether a force of an equilibrium is one to judge by."""
    return found.converged or found.residual_mN <= SETTLED * force_mN


def judge(
    world: World,
    held: Grips,
    rows: thread_pull.Constraints | None,
    taut: list[tuple[int, int, Cable]],
    found: Result,
    time_s: float,
) -> None:
    """Judge the forces that an equilibrium ``found``, once they are settled.

    What gives way in one movement: of each thread that is drawn taut its weakest grip, or the thread; of all holes the
    one that is pulled furthest over what it bears; the needle's grip; and each wall in jaws. The rest may bear without
    them, and is judged by the next equilibrium.
    """
    by_needle, by_jaw = _pulls(world, held, found.anchor_force)
    loads = [length(f) for f in by_jaw]
    world.tissue_force_mN = max(world.tension_mN, length(by_needle), *loads)
    if settled(found, world.tissue_force_mN):
        holes = _on_needle(held, found.anchor_force)
        for (first, last, cable), tension in zip(taut, found.tension, strict=True):
            assert rows is not None
            if not _draw(world, rows, first, last, float(tension), time_s):
                holes += _on_thread(rows, first, last, cable, float(tension))
        _tear_worst(world, holes, time_s)
        _judge_needle(world, length(by_needle), time_s)
        for i, load in enumerate(loads):
            _judge_jaw(world, i, load, time_s)
        check_limit(world, "tissue_pull", world.tissue_force_mN, "", "", time_s)
    _pressures(world, time_s)


def relieve(world: World, time_s: float) -> thread_pull.Slack | None:
    """A thread pulled apart further than it and the tissue give: the weakest grip slips, or it breaks.

    Returns how the thread then runs; None without one.
    """
    if world.thread is None:
        return None
    while True:
        for jaw in world.jaws:
            jaw.lag_mm = 0.0
        slack = thread_pull.slacken(world)
        found = thread_pull.overdrawn(world, slack)
        if found is None:
            return thread_pull.lend(world, slack.held) if any(jaw.lag_mm for jaw in world.jaws) else slack
        # Rigid, its load rises until something gives way.
        _draw(world, slack.held, *found, math.inf, time_s)


def _pulls(world: World, held: Grips, force: Array) -> tuple[Array, list[Array]]:
    """Force on the tissue by the needle (3,) mN, and by each instrument's jaws."""
    by_needle, by_jaw = np.zeros(3), [np.zeros(3) for _ in world.jaws]
    for r, who in enumerate(held.owner):
        if isinstance(who, int):
            by_jaw[who] += force[r]
        else:
            by_needle += force[r]
    return by_needle, by_jaw


def _on_needle(held: Grips, force: Array) -> list[tuple[Hole, float]]:
    return [(who, length(force[r])) for r, who in enumerate(held.owner) if isinstance(who, Hole)]


def _on_thread(
    rows: thread_pull.Constraints, first: int, last: int, cable: Cable, tension: float
) -> list[tuple[Hole, float]]:
    """Pull of a taut thread on each hole of a run: tension times the sum of its ways outside the channel."""
    found = []
    place, channel = rows.position.tolist(), cable.channel.tolist()
    for row in range(first + 1, last):
        hole = rows.hole[row]
        assert hole is not None
        pull = [0.0, 0.0, 0.0]
        for other, inside in ((row - 1, channel[row - 1 - first]), (row + 1, channel[row - first])):
            size = math.dist(place[other], place[row])
            if not inside and size > 0.0:
                pull = [p + tension * (a - b) / size for p, a, b in zip(pull, place[other], place[row], strict=True)]
        found.append((hole, math.hypot(*pull)))
    return found


def _draw(world: World, rows: thread_pull.Constraints, first: int, last: int, tension: float, time_s: float) -> bool:
    """Whether a run of thread gave way: it slips from its weakest grip, or breaks, whichever comes first.

    Of a rigid run, whose ``tension`` is infinite, the load that is told is the one at which it gave way.
    """
    spec = world.task.scene.thread
    assert spec is not None
    gripping = [g for g in (rows.grip[first], rows.grip[last]) if g >= 0]
    if rows.grip[first] < 0 and (leader := world.needle_tool()) is not None:
        gripping.append(leader)
    weakest = min(gripping, key=lambda i: grasp.capacity_mN(world, i))
    limit, strength = grasp.capacity_mN(world, weakest), spec.strength_mN.value
    bears = min(limit, strength)
    if tension <= bears:
        return False
    load = bears if math.isinf(tension) else tension
    if limit <= strength:
        grasp.slip(world, weakest, load, limit, time_s)
    else:
        thread_pull.snap(world, 0.5 * float(rows.arc[first] + rows.arc[first + 1]), load, time_s)
    return True


def _tear_worst(world: World, holes: list[tuple[Hole, float]], time_s: float) -> None:
    """The hole that is pulled furthest over what its wall bears rips out."""
    assert world.tissue is not None
    limits = [world.tissue.vessels[h.place.vessel].spec.tear_mN.value for h, _ in holes]
    over = [(load / limit, h, load, limit) for (h, load), limit in zip(holes, limits, strict=True) if load > limit]
    over = [o for o in over if o[1].open]
    if not over:
        return
    _, hole, load, limit = max(over, key=lambda o: (o[0], -o[1].number))
    place = hole.place
    pierce.close(world, hole)
    hole.torn = True
    tearing.rip_out(world, hole)
    world.emit(
        Tear, time_s, "", body=world.vessel_name(place), wall=place.wall, hole=hole.number,
        point=world.place_in_world(world.point(place)), force_mN=load, limit_mN=limit,
    )  # fmt: skip


def _judge_needle(world: World, load: float, time_s: float) -> None:
    """The needle slips out of jaws that hold it too weakly."""
    holder = world.needle_tool()
    if holder is not None and load > (limit := grasp.capacity_mN(world, holder)):
        grasp.slip(world, holder, load, limit, time_s)


def _judge_jaw(world: World, tool: int, load: float, time_s: float) -> None:
    """A held wall tears, or slips out of the jaws."""
    jaw = world.jaws[tool]
    if jaw.target != "wall":
        return
    assert world.tissue is not None and world.solver is not None
    vessel = world.tissue.vessels[jaw.vessel].spec
    limit = grasp.capacity_mN(world, tool)
    if load > vessel.tear_mN.value:
        wall, torn, nodes = jaw.wall, jaw.vessel, world.solver.compliance.slot_nodes[jaw.slots[0]]
        grasp.let_go(world, jaw)
        tearing.rip_from_jaws(world, torn, nodes)
        world.emit(
            Tear, time_s, world.tools[tool], body=vessel.name, wall=wall, hole=-1,
            point=world.place_in_world(jaw.pose.position), force_mN=load, limit_mN=vessel.tear_mN.value,
        )  # fmt: skip
    elif load > limit:
        grasp.slip(world, tool, load, limit, time_s)


def _pressures(world: World, time_s: float) -> None:
    """Report jaws that press a wall harder than the task allows: a matter of their closure, not of an equilibrium."""
    for i, jaw in enumerate(world.jaws):
        pressure, body = 0.0, ""
        if jaw.target == "wall" and world.tissue is not None:
            pressure, body = grasp.pressure_kPa(world, i), world.tissue.vessels[jaw.vessel].spec.name
        check_limit(world, "grasp_pressure", pressure, world.tools[i], body, time_s)


def check_limit(world: World, name: str, value: float, tool: str, body: str, time_s: float) -> None:
    """Report that ``value`` exceeds the task's limit ``name``, once for each excursion."""
    limit = world.task.limits.get(name)
    if limit is None:
        return
    key = f"{name} {tool}"
    if value > limit.value and key not in world.over:
        world.over.add(key)
        world.emit(Overforce, time_s, tool, body=body, quantity=name, value=value, limit=limit.value, unit=limit.unit)
    elif value < REARM * limit.value:
        world.over.discard(key)
