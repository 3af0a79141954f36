"""What the report of a trainee's progress says about attempts, and what it keeps quiet about."""

from __future__ import annotations

import dataclasses
import io
import json
import re
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from tests.metrics.synthetic_session import DRIVE, at, performed, record, stitch
from trainer.events import StepDone, TaskDone
from trainer.log.record import ANATOMY, ANATOMY_SHA256, SessionRecord
from trainer.metrics.learning import recent, trend
from trainer.reporting import terminal, wording
from trainer.reporting.page import progress_page
from trainer.reporting.progress import ProgressReport, progress_report
from trainer.reporting.summary import curve_words


def attempts(angles: list[float], outcome: str = "completed") -> list[SessionRecord]:
    """Sessions of one task, a day apart, each entered at an angle."""
    return [
        record(stitch(angle=a), session=f"S-{i}", outcome=outcome, started_at=f"2026-10-{i + 1:02d}T09:00:00+00:00")
        for i, a in enumerate(angles)
    ]


def curve(report: ProgressReport, name: str = "entry_angle_error_deg"):  # type: ignore[no-untyped-def]
    return next(c for c in report.tasks[0].curves if c.name == name)


@given(st.floats(-5.0, 5.0), st.floats(-100.0, 100.0), st.integers(3, 20))
@settings(deadline=None)
def test_the_slope_of_points_on_a_line_is_the_lines(slope: float, start: float, n: int) -> None:
    """Exact but for the rounding of 200 additions of numbers up to 200: 1e-12."""
    found = trend(range(1, n + 1), [start + slope * i for i in range(1, n + 1)])
    assert found is not None
    assert found.slope == pytest.approx(slope, abs=1e-12)
    assert found.intercept == pytest.approx(start, abs=1e-11)


def test_one_bad_attempt_does_not_turn_the_slope() -> None:
    """Theil and Sen's line bears 29 % of outliers: one of eight leaves most pairs on the line."""
    values = [80.0 - 5.0 * i for i in range(8)]
    values[7] = 400.0
    found = trend(range(8), values)
    assert found is not None
    assert found.slope == pytest.approx(-5.0)


def test_two_attempts_have_no_slope_and_none_no_median() -> None:
    assert trend([1, 2], [3.0, 4.0]) is None
    assert recent([]) is None
    assert recent([9.0, 1.0, 2.0, 6.0]) == 2.0


def test_a_learning_curve_follows_the_attempts_in_time() -> None:
    made = attempts([50.0, 60.0, 70.0, 80.0])
    found = progress_report(reversed(made))
    assert curve(found).attempts == (1, 2, 3, 4)
    assert curve(found).values == pytest.approx((40.0, 30.0, 20.0, 10.0))
    assert curve(found).recent == pytest.approx(20.0)
    assert "Slope -10.0° per attempt" in curve_words(curve(found))


def test_an_attempt_that_was_not_completed_is_listed_but_not_on_the_curve() -> None:
    made = attempts([50.0, 60.0, 70.0])
    made[1] = dataclasses.replace(made[1], outcome="timeout")
    found = progress_report(made)
    assert curve(found).attempts == (1, 3)
    assert [a.outcome for a in found.tasks[0].attempts] == ["completed", "timeout", "completed"]
    assert found.tasks[0].completed == 2


def test_a_running_session_is_left_out() -> None:
    made = attempts([50.0, 60.0])
    running = dataclasses.replace(made[1], status="running", outcome="")
    assert len(progress_report([made[0], running]).tasks[0].attempts) == 1
    with pytest.raises(ValueError, match="no session has ended yet"):
        progress_report([running])


def test_best_is_nearest_to_the_target_then_the_way_the_metric_improves() -> None:
    found = progress_report(attempts([65.0, 72.0, 85.0, 75.0]))
    rows = {r.last.name: r for r in found.tasks[0].rows}
    assert rows["entry_angle_deg"].best == pytest.approx(85.0)
    assert rows["entry_angle_deg"].best_attempt == 3
    assert rows["entry_angle_deg"].last.value == pytest.approx(75.0)
    assert rows["entry_angle_deg"].earlier == pytest.approx((65.0, 72.0, 85.0))


def test_tasks_are_reported_apart() -> None:
    found = progress_report([*attempts([50.0]), record((), reference=DRIVE, session="D")])
    assert {t.task for t in found.tasks} == {"anastomosis/single-stitch", DRIVE}
    assert len(progress_report(attempts([50.0] * 7)).tasks[0].stitch_map.stitches) == 5
    assert sum(progress_report(attempts([50.0] * 7)).tasks[0].histogram.counts) == 7


@pytest.mark.parametrize("n", [1, 2, 3, 16])
def test_the_page_is_whole_for_few_and_many_attempts(n: int) -> None:
    made = [performed(i, 0.5, session=f"S-{i}", started_at=f"2026-10-{i + 1:02d}T09:00:00+00:00",
                      trainee="<Ada & Co>") for i in range(n)]  # fmt: skip
    found = progress_report(made)
    page = progress_page(found)
    for drawing in re.findall(r"<svg.*?</svg>", page, re.DOTALL):
        ElementTree.fromstring(drawing)
    assert "&lt;Ada &amp; Co&gt;" in page
    assert "<Ada" not in page
    assert "asymptote" not in page
    assert not re.search(r"""(src|href)=["'](?!#)|@import|url\(|<script""", page)
    json.dumps(dataclasses.asdict(found), allow_nan=False)


@pytest.mark.parametrize(("width", "roomy"), [(40, False), (60, False), (80, False), (120, True)])
def test_strips_are_shown_whole_or_not_at_all_and_no_value_is_cut(width: int, roomy: bool) -> None:
    """A strip has 20 cells, and where there is room each target has one; a line may end between words only."""
    console = Console(record=True, width=width, file=io.StringIO())
    found = progress_report([performed(i, 0.3, session=f"S-{i}") for i in range(3)])
    terminal.print_progress(found, console)
    said = console.export_text()
    assert "…" not in said
    shown = re.findall("[━·●◆]+", said)
    assert {len(s) for s in shown} <= {20}
    assert len(shown) == (sum(r.last.has_target for r in found.tasks[0].rows) if roomy else 0)
    joined = " ".join(said.split())
    for r in found.tasks[0].rows:
        assert wording.quantity(r.last.value, r.last.unit) in joined
        assert wording.quantity(r.best, r.last.unit) in joined


def test_the_terminal_shows_each_curve() -> None:
    console = Console(record=True, width=120, file=io.StringIO())
    terminal.print_progress(progress_report(attempts([50.0, 60.0, 70.0])), console)
    said = console.export_text()
    assert "█▆▄" in said  # errors 40, 30 and 20 degrees: full, three quarters, half
    assert "3 attempts, 3 completed." in said


def in_knee(number: int, reference: str, fingerprint: str) -> SessionRecord:
    """A session of the knee, a day after the one before."""
    made = record(
        session=f"S-{number}", reference="arthroscopy/probe-landmarks",
        started_at=f"2026-10-{number + 1:02d}T09:00:00+00:00",
    )  # fmt: skip
    versions = {ANATOMY: reference, ANATOMY_SHA256: fingerprint}
    return dataclasses.replace(made, header=dataclasses.replace(made.header, versions=versions))


BUILT_IN, OWN = ("knee", "aa" * 32), ("/data/my-knee", "bb" * 32)


def test_each_knee_has_attempts_and_curves_of_its_own() -> None:
    """In whatever order they were practised in, a knee that was moved is the same, and one of the same name is not."""
    places = [BUILT_IN, OWN, BUILT_IN, ("/moved/my-knee", OWN[1]), ("/other/my-knee", "cc" * 32)]
    found = progress_report([in_knee(i, *place) for i, place in enumerate(places)])
    assert [(t.anatomy, [a.session for a in t.attempts], [a.number for a in t.attempts]) for t in found.tasks] == [
        ("built-in knee", ["S-0", "S-2"], [1, 2]),
        ("my-knee, bbbbbbbb", ["S-1", "S-3"], [1, 2]),
        ("my-knee, cccccccc", ["S-4"], [1]),
    ]
    contacts = [next(c for c in t.curves if c.name == "iatrogenic_contact_count") for t in found.tasks]
    assert [(c.title, len(c.values)) for c in contacts] == [("Iatrogenic contact count", n) for n in (2, 2, 1)]
    console = Console(record=True, width=120, file=io.StringIO())
    terminal.print_progress(found, console)
    for said in (console.export_text(), progress_page(found)):
        assert said.count("Touch the landmarks of the knee – ") == 3
        assert wording.KNEES_APART in " ".join(said.split())


def test_one_knee_is_named_once_and_nothing_is_said_of_others() -> None:
    found = progress_report([in_knee(i, *OWN) for i in range(3)])
    assert [(t.anatomy, len(t.attempts)) for t in found.tasks] == [("my-knee", 3)]
    page = progress_page(found)
    assert page.count("my-knee") == 1
    assert wording.KNEES_APART not in page
    assert wording.KNEES_APART not in progress_page(progress_report(attempts([50.0, 60.0])))


def test_what_has_no_better_value_has_no_best() -> None:
    """How far tissue draws back is told, and is neither good nor bad."""
    nowhere = (0.0, 0.0, 0.0)
    cut = StepDone(**at(1), step="cut it through", index=3)
    end = TaskDone(
        **at(2), outcome="completed", reason="", needle_tip=nowhere, needle_tangent=nowhere, thread_end=nowhere,
        thread_length_error=0.0, tail_mm=0.0, gap_mm=2.5,
    )  # fmt: skip
    found = progress_report([record((cut, end), reference="arthroscopy/ligament-release")])
    rows = {r.last.name: r for r in found.tasks[0].rows}
    assert (rows["retraction_mm"].last.value, rows["retraction_mm"].best) == (2.5, None)
    assert rows["iatrogenic_contact_count"].best == 0.0
