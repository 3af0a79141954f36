"""The needle's tip at a wall: what it takes to go through, and what lets it go."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from needle_at_wall import TASK, VESSEL, Needle

from trainer.events import Pierce
from trainer.geometry import Rigid, unit
from trainer.interactions.pierce import SIDEWAYS
from trainer.mechanics.attachments import Anchors
from trainer.mechanics.equilibrium import Equilibrium, Result


def test_the_force_of_a_pierce_is_that_of_the_wall_as_it_gives_way() -> None:
    """Along the needle its puncture force; of a tip pushed aside the whole force, SIDEWAYS times as much.

    Exactly: the instant is interpolated to it. Along the needle the tip pushes less then, and may even pull.
    """
    limit = VESSEL.puncture_outer_mN.value
    n = Needle()
    across = np.cross(n.axis, n.normal)
    ways = {  # how steep the needle is, degrees; the way of its tip; the force that makes the hole
        "along itself": (80.0, np.cos(np.radians(80.0)) * n.axis - np.sin(np.radians(80.0)) * n.normal, limit),
        "across and down": (20.0, 0.9 * across - 0.43 * n.normal, SIDEWAYS * limit),
    }
    for name, (steep, way, expected) in ways.items():
        n = Needle()
        start = n.touch(steep)
        made = [
            e
            for k in range(400)
            for e in n.to(Rigid(start.position + 0.005 * (k + 1) * unit(way), start.quaternion))
            if isinstance(e, Pierce)
        ]
        assert made, name
        assert made[0].force_mN == pytest.approx(expected, abs=1e-12), name


@pytest.mark.parametrize("lift_deg", [0.0, 10.0])
def test_a_tip_that_is_drawn_back_takes_none_of_the_wall_along(lift_deg: float) -> None:
    """The tip has touched, and goes back along the wall, or lifts off it: no sharp point drags what it does not press.

    Either it lets go or it makes a hole, so that no movement ends with a force above that of a tip pushed aside; a
    tenth more may be unsettled. In the end it is 1.8 mm away, and the wall at rest, the only state without force.
    """
    n = Needle()
    start = n.touch(35.0)
    way = -np.cos(np.radians(lift_deg)) * n.axis + np.sin(np.radians(lift_deg)) * n.normal
    world = n.scene.world
    for k in range(60):
        events = n.to(Rigid(start.position + 0.03 * (k + 1) * way, start.quaternion))
        assert not [e for e in events if isinstance(e, Pierce)]
        assert world.tissue_force_mN <= 1.1 * SIDEWAYS * VESSEL.puncture_outer_mN.value, k
    assert world.contact is None
    assert world.solver is not None
    assert np.array_equal(world.solver.x, world.solver.mesh.rest)


def test_nothing_is_judged_by_forces_that_are_not_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """While a solve leaves as much unbalanced as the tip pushes, it makes no hole and exceeds no limit of the task.

    The tip goes 0.6 mm into the wall so, and when the forces settle there, both are told at once. The limit is lowered
    to what so soft a wall bears.
    """
    limit = replace(TASK.limits["tissue_pull"], value=2.0)
    solve = Equilibrium.solve

    def unsettled(self: Equilibrium, anchors: Anchors, *rest: Any, **options: Any) -> Result:
        found = solve(self, anchors, *rest, **options)
        return replace(found, converged=False, residual_mN=float(np.sum(np.abs(found.anchor_force))))

    n = Needle(replace(TASK, limits={"tissue_pull": limit}))
    start = n.touch(80.0)
    with monkeypatch.context() as m:
        m.setattr(Equilibrium, "solve", unsettled)
        for k in range(60):
            there = Rigid(start.position - 0.01 * (k + 1) * n.normal, start.quaternion)
            assert n.to(there) == ()
    assert n.scene.world.tissue_force_mN > limit.value
    assert {"pierce", "overforce"} <= {e.kind for e in n.to(there)}
