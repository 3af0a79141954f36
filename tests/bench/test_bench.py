"""``trainer bench``: what is measured is right. How fast it is, no test asks."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from trainer.bench import equilibria, page, realtime, vessel
from trainer.bench.chart import chart
from trainer.bench.rows import Row, left_out, median_and_p90, plain, worst
from trainer.bench.vessel import Work
from trainer.clock import Realtime
from trainer.mechanics.links import forces, hessian

CommandLine = Callable[..., tuple[int, str, str]]
MESH, FRAMES = (7, 8), 7


@pytest.fixture(scope="module", params=[True, False], ids=["both ends clamped", "cut free"])
def work(request: pytest.FixtureRequest) -> Work:
    return vessel.prepare(*MESH, both_ends=request.param)


def test_the_answers_are_in_equilibrium_and_stable_with_the_node_in_its_place(work: Work) -> None:
    """No force on a free node beyond REFERENCE_mN, clamps unmoved, and a stiffness that resists every motion."""
    fixed = work.mesh.fixed
    assert sorted([*work.free, work.node, *np.flatnonzero(fixed)]) == list(range(len(fixed)))
    assert sorted(work.elimination) == np.flatnonzero(~fixed).tolist()
    clamps = len({round(float(v), 9) for v in work.mesh.rest[fixed][:, 0]})
    assert clamps == (2 if work.ends == "both ends clamped" else 1)
    as_built = vessel.prepare(*MESH, both_ends=False).mesh.rest_length
    assert np.allclose(np.sort(work.mesh.rest_length), np.sort(as_built), rtol=1e-12)  # rounding of a difference
    coordinates = (3 * work.free[:, None] + np.arange(3)).ravel()
    for place, x in zip(work.places, work.answers, strict=True):
        assert np.array_equal(x[work.node], place)
        assert np.array_equal(x[fixed], work.mesh.rest[fixed])
        assert np.linalg.norm(forces(work.mesh, x)[work.free]) <= equilibria.REFERENCE_mN
        stiffness = hessian(work.mesh, x)[np.ix_(coordinates, coordinates)]
        assert np.linalg.eigvalsh(stiffness)[0] > 0.0
    way = np.linalg.norm(work.places[-1] - work.places[0])
    assert way == pytest.approx(0.28 * work.radius_mm)


@pytest.mark.parametrize("name", list(vessel.METHODS))
def test_a_converged_method_finds_the_answer(work: Work, name: str) -> None:
    """A residual r leaves the nodes within r / λ of the answer, λ the softest stiffness there, to first order.

    Twice that for the second order. The relaxation measures its residual while it sweeps, before the nodes move on,
    so that ten times its own bound is allowed for; the kept factor's spring gives way by f / SPRING, far less.
    """
    row = vessel.track(work, ((name, 1e-5),), math.inf)[0]
    assert row.status == "converged"
    assert row.frames == 2 * FRAMES
    assert row.residual <= 10.0 * 1e-5
    coordinates = (3 * work.free[:, None] + np.arange(3)).ravel()
    softest = min(np.linalg.eigvalsh(hessian(work.mesh, x)[np.ix_(coordinates, coordinates)])[0] for x in work.answers)
    give = np.max(np.abs([forces(work.mesh, x)[work.node] for x in work.answers])) * math.sqrt(3) / vessel.SPRING
    rounding = 1e-12  # mm: of coordinates of 1 mm, over a way that is a thousand times as soft as a link
    assert row.error * work.radius_mm <= 2.0 * (row.residual * work.first_mN / softest + give) + rounding


def test_a_method_that_is_stopped_says_so_and_shows_its_error(work: Work) -> None:
    """Ten sweeps, after which the relaxation first asks for the time, move no node by all the way that it lacks."""
    [row] = vessel.start_cold(work, (("relaxation", 1e-9),), seconds=1e-9, starts=2)
    assert row.status == "stopped in 1 of 1 frames"
    assert row.error > 1e-3
    assert row.residual > 1e-3


def test_the_memory_limit_is_that_of_the_bytes_that_an_iteration_reads(work: Work) -> None:
    """A factor read twice and held once: what is moved is more than what is held, and less than twice, by iteration."""
    method, limit = vessel.track(work, (("Newton–Krylov", 1e-3),), math.inf)
    assert limit.method == "memory limit of Newton–Krylov"
    assert limit.size == method.size
    moved, held = (float(words.split(" MB")[0].split()[-1]) for words in limit.setting.split(" of "))
    assert held > 0.0
    assert 1.0 <= moved / held <= 2.0 * 50


def test_what_is_left_out_is_in_the_rows_with_its_reason() -> None:
    for quick in (True, False):
        for case in vessel.cases(quick):
            here = {name for name, _ in case.candidates} | {name for name, _ in case.left_out}
            assert here == set(vessel.METHODS), "each method is measured, or said to be left out"
    rows = vessel.measure(True, [vessel.Case(5, 8, True, 1, (), (("relaxation", "skipped: a reason"),))])
    assert [(r.method, r.size, r.frames, r.status) for r in rows] == 2 * [("relaxation", 80, 0, "skipped: a reason")]


def rows() -> dict[str, list[Row]]:
    error_of = vessel.ERROR_OF
    timed = [
        Row(
            case, size, method, f"to {error:g}", 14, ms, 2 * ms, error, error_of, 10 * error, "converged", "share", 1e-4
        )
        for case in ("tracking", "cold")
        for size in (312, 1984)
        for method, factor in (("relaxation", 100.0), ("kept factor", 1.0))
        for error, ms in ((1e-1, 0.5 * factor), (1e-5, 0.8 * factor))
    ]
    skipped = left_out("cold", 9999, "relaxation", "skipped: too slow", error_of, "share")
    limit = Row("cold", 312, "memory limit of all", "9 MB", 14, 0.1, math.nan, math.nan, error_of, math.nan, "bound")
    return {"vessel": [*timed, skipped, limit]}


ABOUT = {
    "cpu": "a <processor>",
    "cores": 2,
    "system": "Linux x86_64",
    "load_before": 0.5,
    "load_after": 1.5,
    "versions": {"numpy": "2.4"},
}


def test_the_report_holds_every_row_and_says_on_what_it_was_made(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "reports"
    written = page.write(folder, rows(), ABOUT, quick=True)
    assert [p.name for p in written] == ["speed_error.md", "speed_error.svg", "speed_error.json"]
    found = json.loads((folder / "speed_error.json").read_text())
    assert found["rows"] == [{"subject": "vessel", **plain(r)} for r in rows()["vessel"]]
    assert [found["rows"][-2][k] for k in ("median_ms", "p90_ms", "error", "residual")] == 4 * [None]
    assert found["machine"] == ABOUT
    words = (folder / "speed_error.md").read_text()
    table = [line for line in words.splitlines() if line.startswith(("| tracking |", "| cold |"))]
    assert len(table) == len(rows()["vessel"])
    assert "| cold | 9999 | relaxation | none | 0 |  |  |  |  | skipped: too slow |" in table
    assert "--quick" in words
    assert "a <processor>, 2 cores, Linux x86_64; load 0.5 before and 1.5 after; numpy 2.4" in words
    drawn = ElementTree.fromstring((folder / "speed_error.svg").read_text())
    assert sum(e.tag.endswith("circle") for e in drawn.iter()) == len(rows()["vessel"]) - 2


def test_an_error_of_nothing_is_drawn_at_the_foot(tmp_path: Path) -> None:
    """It has no place on a logarithmic axis: the lowest line, which no other point reaches, is its own, and says so."""
    exact = [Row("find", 9, "all pairs", "", 3, 1.0, 1.0, error, "share", 0.0, "done") for error in (1e-2, 0.0)]
    words = chart({"contact": exact}, {"contact": "triangles"})
    drawn = ElementTree.fromstring(words)
    above, foot = (float(e.attrib["cy"]) for e in drawn.iter() if e.tag.endswith("circle"))
    assert foot > above
    assert ">0</text>" in words


def test_methods_are_compared_at_the_same_error() -> None:
    """Only settings within the bound of their case count; where a method has none, its best error is told instead of

    a time. What answers nothing is not compared."""
    subject = page.SUBJECTS["vessel"]
    timed = rows()["vessel"]
    assert page.comparison(timed, subject)[0] == (
        "* tracking, 312 nodes, error at most 0.0001: relaxation 80 ms; kept factor 0.8 ms."
    )
    coarse = [r for r in timed if r.method == "kept factor" or r.error > 1e-4]
    assert "relaxation none (best error 1.0e-01 in 50 ms)" in page.comparison(coarse, subject)[0]
    assert "memory limit" not in "".join(page.comparison(timed, subject))
    loose = [replace(r, compared_at=0.2) if r.case == "cold" and r.compared_at else r for r in timed]
    assert page.comparison(loose, subject)[::2] == [
        "* tracking, 312 nodes, error at most 0.0001: relaxation 80 ms; kept factor 0.8 ms.",
        "* cold, 312 nodes, error at most 0.2: relaxation 50 ms; kept factor 0.5 ms.",
    ]


def test_few_frames_have_a_median_and_no_percentile() -> None:
    """Between the fourth and the fifth of five the 90th percentile lies in 0.6 of the way."""
    assert median_and_p90([3.0, 1.0, 2.0, 5.0, 4.0]) == (3.0, pytest.approx(4.6))
    median, p90 = median_and_p90([3.0, 1.0, 2.0, 5.0])
    assert (median, math.isnan(p90)) == (2.5, True)


def test_what_is_not_finite_is_the_worst_and_null_in_json() -> None:
    """An error that is no number would pass for none by ``max``."""
    assert worst(worst(0.1, math.nan), 0.2) == math.inf
    assert worst(0.1, 0.2) == 0.2
    row = replace(rows()["vessel"][0], error=math.inf)
    assert plain(row)["error"] is None
    assert "| inf |" in page.markdown({"vessel": [row]}, ABOUT, quick=True)
    assert ElementTree.fromstring(chart({"vessel": [row]}, {"vessel": "nodes"})).tag.endswith("svg")


def performed(lengths: list[int], outcomes: list[str]) -> realtime.Perform:
    """Sessions that end by themselves after so many ticks, of 1 ms, 2 ms … of work."""

    def perform(number: int, clock: Realtime, enough: Callable[[], bool]) -> str:
        for _ in range(lengths[number]):
            if enough():
                return "aborted"
            clock.work_ms.append(number + 1.0)
        return outcomes[number]

    return perform


def test_sessions_repeat_until_the_time_is_over_and_all_their_ticks_count() -> None:
    found = realtime.measure(performed([4, 3, 9], ["completed", "timeout", "completed"]), tick_hz=400.0, seconds=0.025)
    assert found["sessions"] == ["completed", "timeout", "cut short"]
    assert found["ticks"] == 10  # 4 of 1 ms, 3 of 2 ms, 3 of 3 ms; a slot is 2.5 ms
    assert (found["overruns"], found["p50_ms"], found["max_ms"]) == (3, 2.0, 3.0)


def test_a_session_that_its_trainee_stops_is_the_last() -> None:
    found = realtime.measure(performed([2, 1], ["completed", "aborted"]), tick_hz=100.0, seconds=1.0)
    assert (found["ticks"], found["seconds"]) == (3, 0.03)


def test_a_task_in_real_time(command_line: CommandLine, own_log: Path) -> None:
    """The whole line for a moment; nothing of it enters the user's log. One tick more closes the session."""
    code, out, _ = command_line("bench", "realtime", "--seconds", "0.2", "--task", "anastomosis/needle-drive", "--json")
    assert code == 0
    found = json.loads(out)
    assert found["task"] == "anastomosis/needle-drive"
    assert (found["ticks"], found["tick_hz"], found["sessions"]) == (21, 100.0, ["cut short"])
    assert 0.0 < found["p50_ms"] <= found["p99_ms"] <= found["max_ms"]
    assert {"cpu", "cores", "system", "load_before", "load_after", "versions"} == set(found["machine"])
    assert not own_log.exists()


@pytest.mark.parametrize(("reports", "quick"), [(True, True), (True, False), (False, False)])
def test_speed_error_writes_where_reports_are_and_a_short_run_replaces_no_whole_one(
    reports: bool, quick: bool, command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if reports:
        (tmp_path / "reports").mkdir()
    monkeypatch.setattr(page, "measure", lambda quick, tell: rows())
    code, out, err = command_line("bench", "speed-error", *(["--quick"] if quick else []), "--json")
    assert code == 0
    assert json.loads(out)["quick"] is quick
    folder = (tmp_path / "reports" if reports else tmp_path) / ("quick" if quick else "")
    assert [p.relative_to(tmp_path) for p in tmp_path.rglob("speed_error.md")] == [
        (folder / "speed_error.md").relative_to(tmp_path)
    ]
    assert "speed_error.md" in err


def test_bench_alone_is_a_short_run_of_all(
    command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    asked: list[tuple[str, float]] = []

    def measured(quick: bool, tell: object) -> dict[str, list[Row]]:
        asked.append(("speed-error", quick))
        return rows()

    def ticked(perform: realtime.Perform, tick_hz: float, seconds: float) -> dict[str, object]:
        asked.append(("realtime", seconds))
        return {"ticks": 1, "sessions": ["cut short"], **realtime.pace(tick_hz, [1.0])}

    monkeypatch.setattr(page, "measure", measured)
    monkeypatch.setattr(realtime, "measure", ticked)
    code, out, _ = command_line("bench")
    assert code == 0
    assert asked == [("speed-error", True), ("realtime", 10.0)]
    assert "kept factor" in out
    assert "overruns" in out
