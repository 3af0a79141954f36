"""Closed-form checks of what is measured at the walls."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.synthetic_session import DRIVE, STITCH, at, pierce, pull_through, record, stitch, task_of, tilted
from tests.metrics.synthetic_session import withdraw as withdrawn
from trainer.events import Event, Pierce, StepDone, Tear
from trainer.metrics import score
from trainer.metrics.piercing import angle_to_plane_deg

ANGLES = st.floats(0.0, 90.0)


def scores(events: tuple[Event, ...], reference: str = STITCH) -> dict[str, float | None]:
    return {m.name: m.value for m in score(record(events, reference=reference), task_of(reference))}


def driven(angles: list[float], **given: float) -> tuple[Event, ...]:
    """Passes through both walls of A at these angles, each withdrawn again."""
    events: list[Event] = []
    for i, angle in enumerate(angles):
        values = {"pass_number": i + 1, "angle": angle, **given}
        outer = pierce(100 * i + 10, wall="outer", **values)
        inner = pierce(100 * i + 20, wall="inner", **values)
        events += [outer, inner, withdrawn(100 * i + 80, inner), withdrawn(100 * i + 90, outer)]
    return tuple(events)


@given(ANGLES, st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda n: math.hypot(*n) > 0.1))
@settings(deadline=None)
def test_angle_of_a_direction_tilted_by_construction(angle: float, normal: tuple[float, float, float]) -> None:
    """A direction built at an angle to a plane measures that angle, whichever way the plane faces.

    Rounding of the built vectors is a few 1e-16 of their length, so the angle is good to about 1e-14 rad;
    1e-10 degrees leaves room. asin would fail here near 90 degrees, where it is good to 1e-6 degrees only.
    """
    length = math.hypot(*normal)
    n = (normal[0] / length, normal[1] / length, normal[2] / length)
    assert angle_to_plane_deg(tilted(angle, n), n) == pytest.approx(angle, abs=1e-10)


def test_a_vector_without_direction_has_no_angle() -> None:
    assert angle_to_plane_deg((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) is None


@given(st.lists(ANGLES, min_size=1, max_size=7))
@settings(deadline=None)
def test_entry_angle_is_the_median_and_its_error_the_mean_distance_from_upright(angles: list[float]) -> None:
    """1e-9 degrees: the built directions are good to 1e-10, see above."""
    found = scores(driven(angles), DRIVE)
    ordered = sorted(angles)
    middle = 0.5 * (ordered[(len(angles) - 1) // 2] + ordered[len(angles) // 2])
    assert found["entry_angle_deg"] == pytest.approx(middle, abs=1e-9)
    assert found["entry_angle_error_deg"] == pytest.approx(sum(90.0 - a for a in angles) / len(angles), abs=1e-9)


def test_only_the_first_crossing_of_a_pass_is_its_entry() -> None:
    events = (pierce(10, angle=70.0), pierce(20, wall="inner", angle=30.0), pierce(30, "B", "inner", "out", angle=20.0))
    assert scores(events)["entry_angle_deg"] == pytest.approx(70.0, abs=1e-9)


def test_a_pass_that_begins_in_the_lumen_is_no_entry() -> None:
    """The second bite of a stitch comes from inside: its angle to the inner wall is not the entry's."""
    from_inside = pierce(20, "B", "inner", "out", angle=30.0, pass_number=2)
    assert scores((pierce(10, angle=50.0), from_inside))["entry_angle_deg"] == pytest.approx(50.0, abs=1e-9)


def test_exit_angle_is_that_of_the_outer_wall_of_the_second_end() -> None:
    found = scores(stitch(angle=80.0, exit_angle=65.0))
    assert found["entry_angle_deg"] == pytest.approx(80.0, abs=1e-9)
    assert found["exit_angle_deg"] == pytest.approx(65.0, abs=1e-9)


def test_bite_is_the_outer_holes_distance_from_the_cut() -> None:
    found = scores(stitch(bite_a=0.3, bite_b=0.6))
    assert (found["bite_A_mm"], found["bite_B_mm"]) == (0.3, 0.6)
    # walls of 0.15 mm: 2 and 4 wall thicknesses, median 3
    assert found["bite_ratio"] == pytest.approx(3.0)


def test_the_back_walls_hole_is_no_bite() -> None:
    front = pierce(10, axial_mm=0.2)
    back = pierce(40, wall="outer", direction="out", axial_mm=0.8, clock_deg=180.0)
    assert scores((front, back), DRIVE)["bite_A_mm"] == 0.2


@pytest.mark.parametrize("clock", [0.0, 30.0, 359.5, 180.0])
def test_clock_is_that_of_the_last_bite(clock: float) -> None:
    assert scores(driven([80.0], clock_deg=clock))["clock_A_deg"] == clock


def test_a_vessel_with_several_marks_has_no_one_clock() -> None:
    """``needle-drive`` marks 12, 2 and 10 o'clock on A."""
    assert scores(driven([80.0], clock_deg=60.0), DRIVE)["clock_A_deg"] is None


def test_placement_error_is_the_distance_on_the_unrolled_wall() -> None:
    """The mark is at 0 degrees and 0.35 mm, R = 0.5 mm: 3-4-5 triangle of 0.3 mm along and 0.4 mm around."""
    around = math.degrees(0.4 / 0.5)
    p = pierce(10, axial_mm=0.65, clock_deg=360.0 - around)
    done = StepDone(**at(20, tool=""), step="drive at 12 o'clock", index=0)
    assert scores((p, done), DRIVE)["placement_error_mm"] == pytest.approx(0.5)


def test_placement_belongs_to_the_last_hole_before_the_step_was_done() -> None:
    early, right = pierce(10, axial_mm=0.9), pierce(30, pass_number=2)
    late = pierce(90, pass_number=3, axial_mm=0.9)
    done = StepDone(**at(30, 1, ""), step="drive at 12 o'clock", index=0)
    assert scores((early, withdrawn(20, early), right, done, late), DRIVE)["placement_error_mm"] == 0.0


def test_depth_is_that_of_the_shallowest_pass() -> None:
    """A pass that came 0.06 mm into a wall of 0.15 mm reached 0.4 of it."""
    shallow = pierce(500, pass_number=9)
    events = (*driven([80.0, 80.0]), shallow, withdrawn(520, shallow, reached_mm=0.06))
    found = scores(events, DRIVE)
    assert found["depth_fraction"] == pytest.approx(0.4)
    assert found["partial_thickness_count"] == 1.0


def tear(tick: int, p: Pierce) -> Tear:
    """The hole of a crossing pulled out."""
    return Tear(**at(tick), body=p.body, wall=p.wall, hole=p.hole, point=p.point, force_mN=160.0, limit_mN=150.0)


def test_a_pass_that_tore_out_of_one_wall_is_partial_and_of_unknown_depth() -> None:
    outer, inner = pierce(10), pierce(20, wall="inner")
    found = scores((outer, tear(50, outer)), DRIVE)
    assert found["partial_thickness_count"] == 1.0
    assert found["depth_fraction"] is None
    assert scores((outer, inner, tear(50, outer)), DRIVE)["partial_thickness_count"] == 0.0
    elsewhere = pierce(30, pass_number=2)
    assert scores((outer, elsewhere, tear(50, elsewhere)), DRIVE)["partial_thickness_count"] == 1.0


@pytest.mark.parametrize("reference", [DRIVE, STITCH])
@pytest.mark.parametrize("name", ["extra_holes", "back_wall_catches", "partial_thickness_count"])
def test_without_a_crossing_there_is_nothing_to_judge(name: str, reference: str) -> None:
    """Whoever did nothing has met no target; one crossing is enough to be judged."""
    assert scores((), reference)[name] is None
    assert scores((pierce(10),), reference)[name] == 0.0


def test_a_pass_under_way_is_neither_shallow_nor_deep() -> None:
    found = scores((pierce(10),), DRIVE)
    assert found["depth_fraction"] is None
    assert found["partial_thickness_count"] == 0.0


@pytest.mark.parametrize(("apart", "caught"), [(89.0, 0.0), (91.0, 1.0), (180.0, 1.0), (271.0, 0.0)])
def test_back_wall_catch_is_one_pass_across_the_lumen(apart: float, caught: float) -> None:
    events = (pierce(10, clock_deg=200.0), pierce(20, wall="inner", clock_deg=(200.0 + apart) % 360.0))
    assert scores(events)["back_wall_catches"] == caught


def test_two_passes_on_opposite_sides_catch_no_back_wall() -> None:
    events = (pierce(10, clock_deg=0.0), pierce(20, clock_deg=180.0, pass_number=2))
    assert scores(events, DRIVE)["back_wall_catches"] == 0.0


def test_no_hole_is_extra_when_each_step_has_one() -> None:
    assert scores(driven([80.0, 80.0, 80.0]), DRIVE)["extra_holes"] == 0.0
    assert scores(stitch())["extra_holes"] == 0.0


def test_a_needle_still_in_its_hole_is_not_extra() -> None:
    assert scores(driven([80.0, 80.0])[:-2], DRIVE)["extra_holes"] == 0.0


def test_each_hole_beyond_the_steps_is_extra() -> None:
    assert scores(driven([80.0] * 5), DRIVE)["extra_holes"] == 2.0


def test_a_hole_left_again_is_extra_where_thread_should_stay() -> None:
    tried = pierce(10, pass_number=7)
    assert scores((tried, withdrawn(20, tried), *stitch()))["extra_holes"] == 1.0


def test_a_torn_hole_is_extra_where_thread_should_stay() -> None:
    entry = next(e for e in stitch() if isinstance(e, Pierce))
    assert scores((*stitch(), tear(1500, entry)))["extra_holes"] == 1.0


def test_a_torn_hole_takes_the_place_of_one_that_may_be_left() -> None:
    """``needle-drive`` lets three holes be left: the third may be torn, a fourth torn one is extra."""
    torn = pierce(500, pass_number=9)
    assert scores((*driven([80.0, 80.0]), torn, tear(520, torn)), DRIVE)["extra_holes"] == 0.0
    assert scores((*driven([80.0, 80.0, 80.0]), torn, tear(520, torn)), DRIVE)["extra_holes"] == 1.0


def test_a_bare_needle_pulled_through_leaves_its_hole_empty() -> None:
    """Without thread nothing stays: three holes are asked for, and the fourth is extra, kept or not."""
    through = [pierce(100 * i, pass_number=i) for i in range(1, 5)]
    events = (*through, *(pull_through(p.tick + 50, p) for p in through))
    assert scores(events[:3] + events[4:7], DRIVE)["extra_holes"] == 0.0
    assert scores(events, DRIVE)["extra_holes"] == 1.0


def test_the_back_walls_hole_is_extra() -> None:
    back = pierce(645, "A", "outer", "out", clock_deg=180.0)
    assert scores((*stitch(), back, pull_through(1200, back)))["extra_holes"] == 1.0
