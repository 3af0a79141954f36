"""Closed-form checks of what joins two ends."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from tests.metrics.synthetic_session import STITCH, pierce, pull_through, record, stitch, task_of
from tests.metrics.synthetic_session import withdraw as withdrawn
from trainer.anatomy.vessel import frame
from trainer.events import Event
from trainer.geometry import unit
from trainer.metrics import score
from trainer.metrics.anastomosis import rest_point

#: Between the two cuts of the task's coaxial ends.
GAP_MM = math.dist(*(v.cut_edge_mm for v in task_of().scene.vessel))


def scores(events: tuple[Event, ...]) -> dict[str, float | None]:
    return {m.name: m.value for m in score(record(events), task_of(STITCH))}


def test_equal_bites_opposite_each_other_make_a_straight_stitch() -> None:
    found = scores(stitch())
    assert found["bite_asymmetry"] == 0.0
    assert found["side_mismatch_mm"] == 0.0
    assert found["obliquity_deg"] == pytest.approx(0.0, abs=1e-12)


def test_asymmetry_is_the_difference_over_the_mean() -> None:
    assert scores(stitch(bite_a=0.3, bite_b=0.5))["bite_asymmetry"] == pytest.approx(0.5)


@pytest.mark.parametrize(("a", "b"), [(10.0, 50.0), (350.0, 30.0), (30.0, 350.0)])
def test_mismatch_is_the_arc_between_the_bites(a: float, b: float) -> None:
    """40 degrees on a circle of 0.5 mm."""
    assert scores(stitch(clock_a=a, clock_b=b))["side_mismatch_mm"] == pytest.approx(0.5 * math.radians(40.0))


@pytest.mark.parametrize(("a", "b"), [(0.0, 20.0), (100.0, 80.0), (350.0, 10.0)])
def test_obliquity_of_a_stitch_between_two_points_of_a_cylinder(a: float, b: float) -> None:
    """Along the axis: bites 0.35 + 0.25; across: the chord 2 R sin(20° / 2)."""
    across = 2.0 * 0.5 * math.sin(math.radians(10.0))
    along = 0.35 + 0.25
    found = scores(stitch(bite_a=0.35, bite_b=0.25, clock_a=a, clock_b=b))
    assert found["obliquity_deg"] == pytest.approx(math.degrees(math.atan2(across, along)))


def test_obliquity_does_not_depend_on_where_the_ends_are_parked() -> None:
    """A hole 0.2 mm aside with bites of 0.35 mm: atan(0.2 / 0.7) = 15.9 degrees, whatever the gap or offset.

    A chord of 0.2 mm on a circle of 0.5 mm spans 2 asin(0.2) of the clock. 1e-9 for rounding.
    """
    task = task_of(STITCH)
    made = record(stitch(clock_b=math.degrees(2.0 * math.asin(0.2))))
    for place in ((0.3, 0.0, 0.0), (-0.3, 0.0, 0.0), (4.0, 0.0, 0.0), (0.5, 0.3, -0.2)):
        b = dataclasses.replace(task.scene.vessel[1], cut_edge_mm=place)
        scene = dataclasses.replace(task.scene, vessel=(task.scene.vessel[0], b))
        found = {m.name: m.value for m in score(made, dataclasses.replace(task, scene=scene))}
        assert found["obliquity_deg"] == pytest.approx(math.degrees(math.atan(0.2 / 0.7)), abs=1e-9)
        assert found["obliquity_deg"] == pytest.approx(15.9, abs=0.05)


def test_the_clock_runs_in_one_sense_on_both_ends() -> None:
    """Equal clock angles on two coaxial ends lie on one line along the axis."""
    a, b = task_of().scene.vessel
    for clock in (0.0, 75.0, 200.0):
        apart = rest_point(b, 0.3, clock) - rest_point(a, 0.3, clock)
        np.testing.assert_allclose(apart, [0.6 + GAP_MM, 0.0, 0.0], atol=2e-15)
    assert rest_point(a, 0.0, 0.0)[2] == pytest.approx(0.5)


AXES = [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.3, -0.5, 0.2), (0.0, 0.0, 2.0), (0.0, -1.0, 0.0)]


@pytest.mark.parametrize("axis", AXES)
def test_places_at_rest_are_those_of_the_simulated_vessel(axis: tuple[float, float, float]) -> None:
    """The metrics may not import the vessel, yet 12 and 3 o'clock must mean the same; 1e-15 of 1 mm for rounding."""
    spec = dataclasses.replace(task_of().scene.vessel[0], axis=axis)
    along, twelve, three = frame(unit(axis))
    for clock, radial in ((0.0, twelve), (90.0, three), (180.0, -twelve)):
        there = np.asarray(spec.cut_edge_mm) + 0.3 * along + 0.5 * radial
        np.testing.assert_allclose(rest_point(spec, 0.3, clock), there, atol=2e-15)


def test_a_withdrawn_hole_makes_no_stitch() -> None:
    events = stitch()
    entry = next(e for e in events if e.kind == "pierce")
    found = scores((*events, withdrawn(1650, entry)))  # type: ignore[arg-type]
    assert found["stitch_count"] == 0.0
    for name in ("bite_asymmetry", "side_mismatch_mm", "obliquity_deg", "tail_mm", "gap_mm"):
        assert found[name] is None


def test_the_needle_may_still_be_in_the_stitch() -> None:
    events = tuple(e for e in stitch() if e.kind != "pull_through")
    assert scores(events)["stitch_count"] == 1.0


def test_the_last_stitch_is_measured() -> None:
    first = stitch(bite_a=0.2, bite_b=0.5)
    second = (
        pierce(1800, "A", "outer", "in", axial_mm=0.3, pass_number=2),
        pierce(1820, "B", "outer", "out", axial_mm=0.3, pass_number=2),
    )
    found = scores((*first, *second, *(pull_through(1900 + i, p) for i, p in enumerate(second))))
    assert found["stitch_count"] == 2.0
    assert found["bite_asymmetry"] == 0.0


def test_a_way_out_of_the_same_vessel_is_no_stitch() -> None:
    assert scores((pierce(10, "A", "outer", "in"), pierce(20, "A", "outer", "out")))["stitch_count"] == 0.0


def test_tail_and_gap_are_those_of_the_end() -> None:
    found = scores(stitch())
    assert (found["tail_mm"], found["gap_mm"]) == (2.4, 0.08)
