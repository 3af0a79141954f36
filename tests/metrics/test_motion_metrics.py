"""Laws of paths, pauses and movements, on motions whose values are known in closed form."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from tests.metrics.synthetic_session import TICK_HZ, at, hold, pierce, reach, record, task_of
from trainer.events import Contact, Event, Grasp, Overforce, Pierce, Release, StepDone
from trainer.geometry import Array
from trainer.metrics import score
from trainer.metrics.motion import runs
from trainer.metrics.track import track

HOME = (0.0, 0.0, 0.0)
FAR = (6.0, 8.0, 0.0)  # 10 mm away


def scores(right: Array, *events: Event, **given: object) -> dict[str, float | None]:
    made = record(tuple(events), right=right, **given)  # type: ignore[arg-type]
    return {m.name: m.value for m in score(made, task_of())}


def filter_gain(hz: float) -> float:
    """Amplitude left of a sine after both passes of a low-pass of order 4 at 6 Hz: 1 / (1 + (tan/tan)^2·4).

    The numbers stand here once more on purpose: every path length ever reported hangs on them.
    """
    ratio = math.tan(math.pi * hz / TICK_HZ) / math.tan(math.pi * 6.0 / TICK_HZ)
    return 1.0 / (1.0 + ratio**8)


@pytest.mark.parametrize("seconds", [1.0, 2.0, 5.0])
def test_path_of_a_straight_reach_is_its_distance(seconds: float) -> None:
    """A minimum-jerk reach of 10 mm from rest to rest: the filter passes its power below 3 Hz unchanged.

    Overshoot of the order-4 filter lengthens the fastest of them by less than 1 %.
    """
    right = np.concatenate([hold(HOME, 1.0), reach(HOME, FAR, seconds), hold(FAR, 1.0)])
    assert scores(right)["path_length_right_mm"] == pytest.approx(10.0, rel=0.01)


def test_path_of_a_circle_is_its_circumference() -> None:
    """Radius 5 mm, 4 turns at 0.5 Hz: chords of 1.8 degrees are short by 1 - sinc = 4e-5.

    The filter's ends are free of the circle's curvature; what they change is below a quarter of the first
    and last 1/6 s of 8 s, i.e. below 1 %.
    """
    angle = np.linspace(0.0, 8.0 * math.pi, 801)
    circle = 5.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    assert scores(circle)["path_length_right_mm"] == pytest.approx(40.0 * math.pi, rel=0.01)


@pytest.mark.parametrize("hz", [1.0, 3.0, 8.0])
def test_a_sine_passes_the_filter_with_the_gain_of_a_butterworth(hz: float) -> None:
    """Away from the ends amplitude A becomes A·|H|², |H|² as in :func:`filter_gain`; 1e-3 of A for the ends' rest."""
    t = np.arange(0.0, 20.0, 1.0 / TICK_HZ)
    right = np.zeros((len(t), 3))
    right[:, 0] = np.sin(2.0 * math.pi * hz * t)
    found = track(record(right=right), "right")
    assert found is not None
    middle = slice(500, 1500)
    np.testing.assert_allclose(found.position[middle], filter_gain(hz) * right[middle], atol=1e-3)


def test_noise_at_rest_is_no_path() -> None:
    """White noise of 0.02 mm for 10 s at 100 Hz.

    The raw sum of steps is N·sigma·sqrt(2)·sqrt(8/pi) = 45 mm. After the filter the speed of each axis has
    variance sigma² · (1/50 Hz) · integral of (2 pi f)² |H|⁴ df, at most up to 1.1 times the cutoff:
    (2 pi)² (6.6 Hz)³ / 3 / 50 · sigma², i.e. at most 0.173 mm/s, a mean speed of 0.28 mm/s and a path of at
    most 2.8 mm. Half of that speed's root mean square is far below the limit of rest: all is idle.
    """
    noise = np.random.default_rng(3).normal(0.0, 0.02, (1001, 3))
    raw = float(np.sum(np.linalg.norm(np.diff(noise, axis=0), axis=1)))
    found = scores(noise)
    assert raw > 40.0
    assert found["path_length_right_mm"] is not None
    assert found["path_length_right_mm"] < 2.8
    assert found["movements_right"] == 0.0


def test_a_gap_counts_as_its_straight_line() -> None:
    """While the device does not see the tool it stays where it was; the way across is the straight line."""
    whole = np.concatenate([hold(HOME, 1.0), reach(HOME, FAR, 4.0), hold(FAR, 1.0)])
    held = whole.copy()
    valid = np.ones((len(whole), 2), dtype=bool)
    valid[250:350, 1] = False
    held[250:350] = whole[249]
    found = scores(held, valid=valid)
    assert found["path_length_right_mm"] == pytest.approx(10.0, rel=0.01)
    assert found["tracking_lost_s"] == pytest.approx(1.0)


def test_a_tool_that_was_never_seen_has_no_path() -> None:
    valid = np.ones((300, 2), dtype=bool)
    valid[:, 1] = False
    found = scores(np.zeros((300, 3)), valid=valid)
    assert found["path_length_right_mm"] is None
    assert found["idle_s"] is None
    assert found["path_length_left_mm"] == pytest.approx(0.0, abs=1e-12)


def there_and_back() -> Array:
    return np.concatenate([hold(HOME, 2.0), reach(HOME, FAR, 2.0), hold(FAR, 3.0), reach(FAR, HOME, 2.0)])


def test_economy_of_straight_ways_between_targets_is_one() -> None:
    """There and back in straight lines: 1, although start and end are the same place.

    The filter's overshoot at the rests lengthens the way by less than 1 %.
    """
    grasp = Grasp(**at(550), target="wall", body="A", arc_mm=0.0, point=FAR, force_mN=1.0)
    opened = Release(**at(899), target="wall", body="A")
    begun = pierce(100)
    assert scores(there_and_back(), begun, grasp, opened)["economy_right"] == pytest.approx(1.0, abs=0.01)


def test_economy_of_a_half_circle_is_two_over_pi() -> None:
    """Diameter over half circumference, between two events; 1 % for the filter's ends."""
    angle = np.linspace(0.0, 2.0 * math.pi, 1001)
    circle = 5.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    found = scores(circle, pierce(250), pierce(750, "B"))
    assert found["economy_right"] == pytest.approx(2.0 / math.pi, rel=0.01)


def test_economy_needs_two_targets() -> None:
    assert scores(there_and_back(), pierce(100))["economy_right"] is None


def test_time_runs_from_the_first_motion_to_the_last_step() -> None:
    """At 2 s a 10 mm reach of 2 s begins: v = 30 D/T (s² - 2 s³ + s⁴) exceeds 0.5 mm/s at s = 0.06, i.e. after 0.12 s.

    The filter spreads the onset by less than its 1/6 s.
    """
    done = StepDone(**at(800, tool=""), step="last", index=3)
    found = scores(there_and_back(), done)
    assert found["time_s"] == pytest.approx(8.0 - 2.12, abs=1.0 / 6.0)


def test_an_unfinished_task_took_until_the_end() -> None:
    done = StepDone(**at(300, tool=""), step="first", index=0)
    whole = len(there_and_back()) / TICK_HZ
    found = scores(there_and_back(), done, outcome="timeout")
    assert found["time_s"] == pytest.approx(whole - 2.12, abs=1.0 / 6.0)


def test_without_motion_there_is_no_time() -> None:
    assert scores(hold(HOME, 3.0))["time_s"] is None


def test_idle_is_where_both_hands_rest() -> None:
    """2 s and 3 s of rest plus the slow beginnings and ends of the reaches, 0.12 s each, three of them adjoining."""
    assert scores(there_and_back())["idle_s"] == pytest.approx(5.0 + 3 * 0.12, abs=0.25)


def test_a_short_pause_is_not_idle() -> None:
    short = np.concatenate([reach(HOME, FAR, 1.0), hold(FAR, 0.2), reach(FAR, HOME, 1.0)])
    assert scores(short)["idle_s"] == 0.0


def test_movements_are_counted_between_rests() -> None:
    assert scores(there_and_back())["movements_right"] == 2.0
    assert scores(there_and_back())["movements_left"] == 0.0


def test_a_slow_drift_is_no_movement() -> None:
    """A steady 1.5 mm/s lies above the speed that ends a movement and below the one that begins it."""
    drift = np.linspace(0.0, 7.5, 501)[:, None] * np.array([1.0, 0.0, 0.0])
    assert scores(drift)["movements_right"] == 0.0


def test_runs_of_flags() -> None:
    flags = np.array([True, False, True, True, False])
    assert runs(flags).tolist() == [[0, 1], [2, 4]]
    assert runs(np.zeros(0, dtype=bool)).shape == (0, 2)


def test_whoever_touched_no_wall_was_not_gentle() -> None:
    """Holding the needle is no touch; a contact, a crossing or a grip of the wall is, and so is excess itself."""
    place = {"axial_mm": 0.35, "clock_deg": 0.0}
    contact = Contact(**at(10), body="A", wall="outer", direction="in", point=HOME, **place)
    wall = Grasp(**at(10), target="wall", body="A", arc_mm=0.0, point=HOME, force_mN=3.0)
    needle = dataclasses.replace(wall, target="needle", body="")
    over = Overforce(**at(10), body="A", quantity="tissue_pull", value=70.0, limit=60.0, unit="mN")
    assert scores(hold(HOME, 1.0))["overforce_count"] is None
    assert scores(hold(HOME, 1.0), needle)["overforce_count"] is None
    for touch in (contact, wall, pierce(10)):
        assert scores(hold(HOME, 1.0), touch)["overforce_count"] == 0.0
    assert scores(hold(HOME, 1.0), over)["overforce_count"] == 1.0


def test_counts_are_those_of_the_events() -> None:
    grasp = Grasp(**at(10), target="wall", body="A", arc_mm=0.0, point=HOME, force_mN=3.0)
    needle = dataclasses.replace(grasp, tick=20, target="needle", body="", force_mN=50.0)
    strong: Pierce = pierce(30, force_mN=7.0)
    found = scores(hold(HOME, 1.0), grasp, needle, strong, pierce(40, wall="inner"))
    assert (found["grasp_count"], found["wall_grasp_count"]) == (2.0, 1.0)
    assert (found["wall_grasp_force_max_mN"], found["puncture_force_max_mN"]) == (3.0, 7.0)
    assert found["overforce_count"] == 0.0
