"""What the report of a session says, and that its page stands alone and is well formed."""

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

from tests.metrics.synthetic_session import DRIVE, at, performed, pierce, record, stitch, task_of
from tests.metrics.synthetic_session import withdraw as withdrawn
from trainer.curriculum import load_task, parse_task
from trainer.events import KINDS, Aborted, Contact, Grasp, Overforce, Probe, TickOverrun, TrackingBack, TrackingLost
from trainer.log.record import ANATOMY, ANATOMY_SHA256
from trainer.reporting import figures, terminal, wording
from trainer.reporting.page import session_page
from trainer.reporting.session import MetricRow, SessionReport, event_lines, session_report
from trainer.reporting.summary import session_summary


def report(**bites: float) -> SessionReport:
    return session_report(record(stitch(**bites)), task_of())


def row(value: float | None, low: float | None, high: float | None, unit: str = "mm") -> MetricRow:
    return MetricRow("bite_A_mm", "Bite A", "Needle", "What.", value, unit, low, high, "assumed", "1")


def svg_of(page: str) -> list[ElementTree.Element]:
    return [ElementTree.fromstring(found) for found in re.findall(r"<svg.*?</svg>", page, re.DOTALL)]


@pytest.mark.parametrize(
    ("value", "low", "high", "met"),
    [
        (1.0, 1.0, 2.0, True), (2.0, 1.0, 2.0, True), (2.1, 1.0, 2.0, False), (0.9, 1.0, None, False),
        (9.0, 1.0, None, True), (0.0, 0.0, 0.0, True), (None, 0.0, 1.0, None), (5.0, None, None, None),
    ],
)  # fmt: skip
def test_a_target_is_a_closed_band(
    value: float | None, low: float | None, high: float | None, met: bool | None
) -> None:
    assert row(value, low, high).met is met


def test_targets_and_other_metrics_are_apart_and_complete() -> None:
    found = report()
    wanted = {t.name for t in task_of().metric if t.low is not None or t.high is not None}
    assert {r.name for r in found.targets} == wanted
    assert not {r.name for r in found.targets} & {r.name for r in found.others}
    assert {r.family for r in (*found.targets, *found.others)} == {"Needle", "Stitch", "Motion", "Handling"}


def test_the_summary_counts_what_was_met_and_names_what_was_missed() -> None:
    found = report(bite_a=0.3, bite_b=0.5, angle=60.0)
    said = session_summary(found)
    met = len(found.targets) - len(found.missed)
    assert said.startswith(f"{met} of {len(found.targets)} targets met.")
    assert "entry angle 60.0° (70 to 90°)" in said
    assert "bite asymmetry 0.50 (0 to 0.25)" in said
    assert "Outside" not in session_summary(report())


def test_the_map_holds_each_outer_hole_its_mark_and_the_stitch() -> None:
    shown = report(bite_a=0.3, clock_a=350.0, angle=70.0).stitch_map
    assert shown.vessels == ("A", "B")
    assert [(b.vessel, b.clock_deg, b.bite_mm) for b in shown.bites] == [("A", 350.0, 0.3), ("B", 0.0, 0.35)]
    assert shown.bites[0].angle_error_deg == pytest.approx(20.0)
    assert {(m.vessel, m.clock_deg, m.bite_mm) for m in shown.marks} == {("A", 0.0, 0.35), ("B", 0.0, 0.35)}
    assert shown.stitches == ((shown.bites[0], shown.bites[1]),)


def test_a_hole_left_again_is_told_from_one_that_holds() -> None:
    p = pierce(10)
    found = session_report(record((p, withdrawn(50, p)), reference=DRIVE), task_of(DRIVE))
    assert [b.kept for b in found.stitch_map.bites] == [False]


@given(st.lists(st.floats(0.0, 90.0), max_size=12))
@settings(deadline=None)
def test_the_histogram_counts_each_pass_once(angles: list[float]) -> None:
    events = tuple(pierce(10 * i, pass_number=i, angle=a) for i, a in enumerate(angles))
    shown = session_report(record(events, reference=DRIVE), task_of(DRIVE)).histogram
    assert len(shown.counts) == 18
    assert sum(shown.counts) == len(angles)


def test_upright_is_in_the_last_bin() -> None:
    assert report().histogram.counts[-1] == 1


def test_events_alike_are_one_line_and_late_ticks_none() -> None:
    late = tuple(TickOverrun(**at(i), work_ms=12.0, slot_ms=10.0) for i in range(3))
    lost = tuple(TrackingLost(**at(10 + i)) for i in range(4))
    back = TrackingBack(**at(20), lost_s=0.5)
    lines = event_lines((*late, *lost, back))
    assert [(e.kind, e.count) for e in lines] == [("tracking_lost", 4)]
    assert session_report(record(late), task_of()).overruns == 3


def test_a_trackers_thousand_losses_are_one_line_for_each_hand() -> None:
    """The hands alternate; 600 losses of 1/8 s and one of 0.5 s are 75.5 s. What a hand does begins a new line."""
    flicker = [
        e
        for i in range(600)
        for tool in ("left", "right")
        for e in (TrackingLost(**at(4 * i, tool=tool)), TrackingBack(**at(4 * i + 2, 1, tool), lost_s=0.125))
    ]
    last = (TrackingLost(**at(2400, tool="left")), TrackingBack(**at(2450, tool="left"), lost_s=0.5))
    again = TrackingLost(**at(2700))
    lines = event_lines((*flicker, *last, pierce(2500), TrackingLost(**at(2600)), again))
    assert [(e.tool, e.kind, e.count) for e in lines] == [
        ("left", "tracking_lost", 601), ("right", "tracking_lost", 600), ("right", "pierce", 1),
        ("right", "tracking_lost", 2),
    ]  # fmt: skip
    assert lines[0].text == "not seen by the device for 75.50 s in all"
    assert lines[1].text == "not seen by the device for 75.00 s in all"
    other = Aborted(**at(20, tool="left"), reason="")
    once = (TrackingLost(**at(10)), other, TrackingBack(**at(30), lost_s=0.2), TrackingLost(**at(40)))
    assert event_lines(once)[0].text == "not seen by the device for 0.20 s, then lost again"


def test_why_an_instrument_was_lost_is_told_the_most_frequent_first() -> None:
    reasons = ["b", "a", "", "a", "c", "d"]
    lost = [TrackingLost(**at(10 * i), reason=reason) for i, reason in enumerate(reasons)]
    back = TrackingBack(**at(60), lost_s=0.5)
    assert wording.describe(lost[0]) == event_lines((lost[0],))[0].text == "not seen by the device: b"
    assert wording.unseen(lost[1:4]) == "not seen by the device: a"
    assert wording.unseen([*lost[:2], back]) == "not seen by the device for 0.50 s: b; a"
    assert wording.unseen(lost) == "not seen by the device: a; b; c; and others"


@pytest.mark.parametrize(("angle", "said"), [(0.0, "0°"), (359.4, "359°"), (359.6, "0°"), (29.6, "30°")])
def test_twelve_is_never_360_degrees(angle: float, said: str) -> None:
    assert wording.clock(angle) == said
    made = session_report(record((pierce(10, clock_deg=angle),), reference=DRIVE), task_of(DRIVE))
    console = Console(record=True, width=100, file=io.StringIO())
    terminal.print_session(made, console)
    for shown in (session_page(made), console.export_text()):
        assert "360°" not in shown
        assert said in shown


def test_a_clock_metric_is_never_a_full_turn() -> None:
    assert wording.quantity(359.96, "deg") == "0.0°"
    assert wording.quantity(359.94, "deg") == "359.9°"


def test_whoever_did_nothing_met_nothing() -> None:
    found = session_report(record((), reference=DRIVE), task_of(DRIVE))
    wanted = len(found.targets)
    assert session_summary(found) == f"0 of {wanted} targets met, {wanted} not measured."
    assert session_page(found).count("not measured</span>") == wanted


@pytest.mark.parametrize("width", [40, 60, 80, 100])
def test_no_width_cuts_a_value(width: int) -> None:
    """Strips are whole or absent, and no cell ends in an ellipsis; words may be on two lines."""
    console = Console(record=True, width=width, file=io.StringIO())
    made = session_report(performed(seed=3, skill=0.3), task_of())
    terminal.print_session(made, console)
    said = console.export_text()
    assert "…" not in said
    assert max(map(len, said.partition("pierce")[0].splitlines())) <= width
    assert {len(s) for s in re.findall("[━·●◆]+", said)} <= {20}
    joined = " ".join(said.split())
    for r in (*made.targets, *made.others):
        assert wording.quantity(r.value, r.unit) in joined
    for r in made.others:
        assert f"{r.title} {wording.quantity(r.value, r.unit)}" in joined


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_event_has_words(kind: str) -> None:
    """Built with a text or number in each field, so that a new kind is tested by existing."""
    cls = KINDS[kind]
    by_type = {"int": 1, "float": 1.0, "str": "word", "Vector": (0.0, 0.0, 1.0)}
    values = {f.name: by_type[str(f.type)] for f in dataclasses.fields(cls)}
    assert wording.describe(cls(**values)).strip()


def test_words_for_what_a_supervisor_looks_for() -> None:
    here = (0.0, 0.0, 0.0)
    touch = Contact(**at(1), body="A", wall="outer", direction="in", point=here, axial_mm=0.3, clock_deg=30.0)
    assert wording.describe(touch) == "outer wall of A, 0.30 mm from the cut at 30°"
    pull = Overforce(**at(1), body="A", quantity="tissue_pull", value=80.0, limit=60.0, unit="mN")
    assert wording.describe(pull) == "tissue pull on A: 80 mN, limit 60 mN"
    assert wording.describe(Aborted(**at(1), reason="by hand")) == "by hand"


def test_the_page_stands_alone() -> None:
    page = session_page(report())
    assert not re.search(r"""(src|href)=["'](?!#)|@import|url\(|<script""", page)
    assert "$" not in re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)
    assert wording.DISCLAIMER in page
    assert "assumed: bites of equal size" in page


def test_names_from_people_are_escaped_everywhere() -> None:
    nasty = "<script>alert('x')</script>&\"$x"
    made = record((*stitch(), Aborted(**at(1800, tool="<u>"), reason="<s>stop</s>")), trainee=nasty, session="<b>")
    text = load_task("anastomosis/single-stitch").text.replace('"B"', '"<p>"')
    task = dataclasses.replace(parse_task(text, "nasty"), title='A <i>task</i> & "more"')
    page = session_page(session_report(made, task))
    assert "<script" not in page
    for word in ("<b>", "<i>", "<u>", "<s>", "<p>B", "><p></text>"):
        assert word not in page
    assert "&lt;p&gt;</text>" in page
    assert "&lt;script&gt;alert(&#x27;x&#x27;)&lt;/script&gt;&amp;&quot;$x" in page


@pytest.mark.parametrize("reference", ["anastomosis/single-stitch", DRIVE])
@pytest.mark.parametrize("empty", [True, False])
def test_figures_are_well_formed_and_inside_their_frame(reference: str, empty: bool) -> None:
    events = () if empty else stitch(bite_a=1.9, clock_a=123.0, angle=3.0)
    page = session_page(session_report(record(events, reference=reference), task_of(reference)))
    drawings = svg_of(page)
    assert len(drawings) >= 2
    for drawing in drawings:
        _, _, width, height = (float(v) for v in drawing.attrib["viewBox"].split())
        for circle in drawing.iter("{http://www.w3.org/2000/svg}circle"):
            assert 0.0 <= float(circle.attrib["cx"]) <= width
            assert 0.0 <= float(circle.attrib["cy"]) <= height


def test_a_dot_lies_at_its_clock_angle_and_bite() -> None:
    """Twelve o'clock is up and three to the right; twice the bite is twice as far beyond the cut edge's circle."""
    faces = {}
    for clock, bite in ((0.0, 0.25), (0.0, 0.5), (90.0, 0.5)):
        made = record((pierce(10, clock_deg=clock, axial_mm=bite),), reference=DRIVE)
        drawing = svg_of(figures.stitch_map(session_report(made, task_of(DRIVE)).stitch_map))[0]
        circles = drawing.findall("{http://www.w3.org/2000/svg}g/{http://www.w3.org/2000/svg}circle")
        edge = next(c for c in drawing.iter("{http://www.w3.org/2000/svg}circle") if c.attrib["r"] == "32")
        dx = float(circles[-1].attrib["cx"]) - float(edge.attrib["cx"])
        dy = float(circles[-1].attrib["cy"]) - float(edge.attrib["cy"])
        faces[clock, bite] = (dx, dy)
    assert faces[0.0, 0.5][0] == pytest.approx(0.0, abs=0.01)
    assert -faces[0.0, 0.5][1] - 32.0 == pytest.approx(2.0 * (-faces[0.0, 0.25][1] - 32.0), abs=0.02)
    assert faces[90.0, 0.5] == pytest.approx((-faces[0.0, 0.5][1], 0.0), abs=0.01)


def test_the_strip_places_the_value_on_its_scale() -> None:
    """Angles run from 0 to 90 degrees over 7 … 125: 45 degrees is the middle, 66."""
    inside = svg_of(figures.strip(row(45.0, 30.0, 60.0, "deg")))[0]
    dot = inside.find("{http://www.w3.org/2000/svg}circle")
    assert dot is not None
    assert float(dot.attrib["cx"]) == pytest.approx(66.0)
    outside = svg_of(figures.strip(row(10.0, 30.0, 60.0, "deg")))[0]
    assert outside.find("{http://www.w3.org/2000/svg}polygon") is not None


def test_the_report_is_json() -> None:
    assert json.loads(json.dumps(dataclasses.asdict(report()), allow_nan=False))["outcome"] == "completed"


def test_the_terminal_tells_the_same() -> None:
    console = Console(record=True, width=100, file=io.StringIO())
    made = session_report(performed(seed=3, skill=0.3, trainee="[bold]Ada[/bold]"), task_of())
    terminal.print_session(made, console)
    said = console.export_text()
    assert "[bold]Ada[/bold]" in said
    assert wording.DISCLAIMER in said
    for r in made.targets:
        assert wording.quantity(r.value, r.unit) in said


def test_the_terminals_strip_marks_value_and_band() -> None:
    """90 degrees over 20 cells: 4.5 degrees each."""
    assert terminal.strip(row(45.0, 36.0, 54.0, "deg")) == "········━━●━━·······"
    assert terminal.strip(row(0.0, 36.0, 54.0, "deg")).startswith("◆·······━")


def test_what_was_out_of_sight_is_said_once_for_hands_that_were_lost_alike() -> None:
    """And not at all where the device saw everything."""
    gone = [TrackingLost(**at(10, tool=t), reason="a") for t in ("left", "right")]
    back = [TrackingBack(**at(30, tool=t), lost_s=0.2) for t in ("left", "right")]
    assert wording.out_of_sight([Aborted(**at(9), reason="")]) == ""
    assert wording.out_of_sight([*gone, *back]) == "left and right not seen by the device for 0.20 s: a"
    again = TrackingLost(**at(40, tool="left"), reason="b")
    assert wording.out_of_sight([*gone, *back, again]) == (
        "left not seen by the device for 0.20 s, then lost again: a; b; right not seen by the device for 0.20 s: a"
    )


def test_the_knee_and_what_was_touched_without_being_asked_for_are_told() -> None:
    touch = Probe(**at(1), body="femur", point=(0.0, 0.0, 0.0))
    grip = Grasp(**at(2), target="tissue", body="posterior cruciate ligament", arc_mm=0.0, point=(0.0, 0.0, 0.0),
                 force_mN=50000.0)  # fmt: skip
    made = record((touch, grip), reference="arthroscopy/ligament-release")
    versions = {ANATOMY: "/data/<my> knee", ANATOMY_SHA256: "bb" * 32}
    made = dataclasses.replace(made, header=dataclasses.replace(made.header, versions=versions))
    report = session_report(made, task_of("arthroscopy/ligament-release"))
    assert [(r.structure, r.asked) for r in report.tissue] == [("posterior cruciate ligament", True), ("femur", False)]
    page = session_page(report)
    assert "<dt>Knee</dt><dd>&lt;my&gt; knee</dd>" in page
    assert page.count("not part of the task") == 1
    assert "50000" not in page  # what the jaws can hold is no force that was measured
    assert ">tacked<" not in page
    console = Console(record=True, width=120, file=io.StringIO())
    terminal.print_session(report, console)
    said = console.export_text()
    assert said.startswith("Release a ligament of the knee – <my> knee")
    assert "femur not part of the task" in said


@pytest.mark.parametrize(
    ("value", "high", "said", "target"),
    [(93.9, 1000.0, "93.9 mN", "0 to 1000 mN"), (20329.7, 30000.0, "20.3 N", "0 to 30 N")],
)
def test_large_forces_are_in_newtons(value: float, high: float, said: str, target: str) -> None:
    assert (wording.quantity(value, "mN"), wording.band(0.0, high, "mN")) == (said, target)
