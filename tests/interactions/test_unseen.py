"""A needle whose way nobody saw: it is found where it is, and no wall was pierced on the way."""

from __future__ import annotations

import numpy as np
import pytest
from needle_at_wall import VESSEL, Needle

from trainer.events import Event, Pierce
from trainer.geometry import Rigid
from trainer.interactions.unseen import STRAIGHT_MM

ABOVE = 2.0  # mm
MIDDLE = -0.5 * VESSEL.outer_diameter_mm  # mm above the wall: in the lumen
TRACKING = {"tracking_lost", "tracking_back"}


def upright(n: Needle, above_mm: float) -> Rigid:
    """The needle pointing down onto the wall (or from within it) with its tip so far above the wall."""
    return n.lying(n.point + above_mm * n.normal, 90.0)


def leap(n: Needle, to_mm: float, unseen_ticks: int) -> list[Event]:
    """In one tick, or after the device saw nothing for some."""
    here = n.scene.world.needle_pose
    return [e for _ in range(unseen_ticks) for e in n.to(here, seen=False)] + list(n.to(upright(n, to_mm)))


def go(n: Needle, from_mm: float, to_mm: float, step_mm: float = 0.02) -> list[Event]:
    ticks = round(abs(to_mm - from_mm) / step_mm)
    return [e for h in np.linspace(from_mm, to_mm, ticks + 1)[1:] for e in n.to(upright(n, float(h)))]


def touches(events: list[Event]) -> list[str]:
    return [
        f"{e.kind} {e.wall} {e.direction}"  # type: ignore[attr-defined]
        for e in events
        if e.kind in ("contact", "pierce")
    ]


ENTERED = ["contact outer in", "pierce outer in", "contact inner in", "pierce inner in"]


@pytest.mark.parametrize("unseen_ticks", [0, 1, 30])
def test_a_needle_found_inside_a_vessel_pierced_nothing_and_has_to_come_out_again(unseen_ticks: int) -> None:
    """Found in the lumen, and from there to and fro in the other wall, it touches nothing; drawn out, it can go in."""
    n = Needle()
    n.to(upright(n, ABOVE))
    in_wall = 2.0 * MIDDLE + 0.5 * VESSEL.wall_mm
    events = leap(n, MIDDLE, unseen_ticks) + go(n, MIDDLE, in_wall) + go(n, in_wall, MIDDLE)
    assert n.scene.world.last_seen is not None
    events += go(n, MIDDLE, 0.2)
    assert touches(events) == []
    assert touches(go(n, 0.2, MIDDLE)) == ENTERED


@pytest.mark.parametrize("unseen_ticks", [0, 30])
def test_a_needle_found_beyond_a_vessel_goes_on_there(unseen_ticks: int) -> None:
    """From above to below: outside again, so that it touches the wall from there."""
    n = Needle()
    n.to(upright(n, ABOVE))
    below = 2.0 * MIDDLE - 1.0
    events = leap(n, below, unseen_ticks)
    assert touches(events) == []
    assert n.scene.world.last_seen is None
    assert touches(go(n, below, 2.0 * MIDDLE + 0.05))[:1] == ["contact outer in"]


def test_a_short_gap_while_the_tip_presses_changes_nothing() -> None:
    """Two ticks unseen, then a little further on: one touch, and the same hole as if it had been seen."""
    found = []
    for unseen in (False, True):
        n = Needle()
        n.to(upright(n, 0.1))
        events = go(n, 0.1, -0.02)
        assert n.scene.world.contact is not None
        if unseen:
            for _ in range(2):
                events += n.to(n.scene.world.needle_pose, seen=False)
        found.append(events + go(n, -0.02, MIDDLE))
    (seen, gap) = found
    assert touches(gap) == touches(seen) == ENTERED
    a, b = (next(e for e in events if isinstance(e, Pierce)) for events in found)
    assert a.point == pytest.approx(b.point, abs=1e-3)


def test_a_tip_that_presses_is_found_again_beside_the_wall() -> None:
    """Lost while it dents the wall: found further off than a straight way, outside, it touches at once again."""
    n = Needle()
    n.to(upright(n, 0.1))
    go(n, 0.1, -0.02)
    assert n.scene.world.contact is not None
    leap(n, 2.0 * STRAIGHT_MM, 5)
    assert n.scene.world.contact is None
    assert n.scene.world.last_seen is None
    assert touches(go(n, 2.0 * STRAIGHT_MM, MIDDLE)) == ENTERED


@pytest.mark.parametrize("back", [True, False])
def test_a_needle_in_a_wall_that_leaps_through_the_other_goes_on_where_it_was(back: bool) -> None:
    """In the lumen through two holes, it leaps through the far wall: no hole. Back in the lumen it can make one.

    Drawn out of its holes from there, it can go in again.
    """
    n = Needle()
    n.to(upright(n, 0.1))
    assert touches(go(n, 0.1, MIDDLE)) == ENTERED
    far = 2.0 * MIDDLE - 0.7
    assert touches(leap(n, far, 10)) == []
    if back:
        assert touches(go(n, far, MIDDLE)) == []
        assert n.scene.world.last_seen is None
        assert touches(go(n, MIDDLE, far))[:2] == ["contact inner out", "pierce inner out"]
    else:
        out = go(n, far, 0.3)
        assert touches(out) == []
        assert [e.kind for e in out].count("withdraw") == 2
        assert n.scene.world.last_seen is None
        assert touches(go(n, 0.3, MIDDLE)) == ENTERED
