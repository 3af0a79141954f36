"""``trainer bench stability``: every hard case ends as it says, and a broken law is neither hidden nor the end."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from trainer import scene
from trainer.bench import hard_scene, scene_laws, stability
from trainer.bench.stability import Case, Outcome
from trainer.curriculum import load_task
from trainer.events import Event
from trainer.geometry import Array, Rigid, quaternion_from_euler_deg
from trainer.poses import ToolPoses

CommandLine = Callable[..., tuple[int, str, str]]

ABOUT = {"cpu": "a processor", "cores": 2, "system": "Linux", "load_before": 0.5, "load_after": 1.0, "versions": {}}


def broken_law() -> str:
    raise AssertionError("a node | leaps")


def mistake() -> str:
    return str(1 // 0)


FAKES: list[Case] = [
    ("easy", "all", lambda: "ok: 1e-9"),
    ("a law", "one", broken_law),
    ("senseless", "one", lambda: "refused: it is not a number"),
    ("endless", "one", lambda: "not converged: residual 1"),
    ("a mistake", "one", mistake),
    ("mumbled", "one", lambda: "perhaps"),
]
ENDINGS = ["ok", "BROKEN", "refused", "not converged", "BROKEN", "BROKEN"]


def test_each_case_is_run_whatever_became_of_those_before() -> None:
    found = stability.collect(FAKES, quick=False)
    assert [(o.case, o.method) for o in found] == [(case, method) for case, method, _ in FAKES]
    assert [o.ending for o in found] == ENDINGS
    assert found[1].outcome == "BROKEN: a node | leaps"
    assert found[4].outcome.startswith("BROKEN: ZeroDivisionError: ")
    assert found[5].outcome == "BROKEN: it answered 'perhaps'"
    assert all(o.seconds >= 0.0 for o in found)


def test_a_quick_run_says_what_it_leaves_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stability, "LONG", {("easy", "all"), ("a law", "another")})
    assert [o.ending for o in stability.collect(FAKES[:2], quick=True)] == ["left out", "BROKEN"]
    assert [o.ending for o in stability.collect(FAKES[:2], quick=False)] == ["ok", "BROKEN"]


def test_what_a_quick_run_leaves_out_are_cases() -> None:
    known = {(case, m) for name in stability.SUBJECTS for case, m, _ in import_module(f"trainer.bench.{name}").cases()}
    assert known >= stability.LONG


def test_no_two_cases_of_a_subject_are_the_same() -> None:
    for name in stability.SUBJECTS:
        names = [(case, method) for case, method, _ in import_module(f"trainer.bench.{name}").cases()]
        assert len(names) == len(set(names))


def outcomes() -> dict[str, list[Outcome]]:
    return {"hard_thread": stability.collect(FAKES[:2], False), "hard_scene": stability.collect(FAKES[2:4], False)}


def test_the_page_names_every_case_the_laws_and_the_machine(tmp_path: Path) -> None:
    path = stability.write(tmp_path / "new", outcomes(), ABOUT, quick=True)
    words = path.read_text(encoding="utf-8")
    assert path.name == "stability.md"
    assert "`trainer bench stability --quick`. a processor, 2 cores" in words
    assert "4 cases: 1 ok, 1 refused, 1 not converged, 1 BROKEN" in words
    assert "| a law | one | BROKEN: a node \\| leaps |" in words
    assert words.index("## The thread") < words.index("| easy |") < words.index("## Whole exercises")
    for laws in (hard_scene.__doc__, import_module("trainer.bench.hard_thread").__doc__):
        assert laws is not None
        assert laws.strip() in words


@pytest.mark.parametrize(("cases", "code"), [(FAKES[:1], 0), (FAKES[2:4], 0), (FAKES[:2], 1)])
def test_the_command_fails_when_a_law_is_broken(
    cases: list[Case], code: int, command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And only then: a refusal and a method that says it did not converge are answers."""
    found = {"hard_thread": stability.collect(cases, False)}
    monkeypatch.setattr(stability, "measure", lambda quick, tell: found)
    ended, out, err = command_line("bench", "stability", "--quick", "--json", "--out", tmp_path / "here")
    assert ended == code
    answer = json.loads(out)
    assert answer["quick"] is True
    assert [c["case"] for c in answer["cases"]] == [case for case, _, _ in cases]
    assert answer["counts"]["BROKEN"] == code
    assert str(tmp_path / "here" / "stability.md") in err
    ended, out, _ = command_line("bench", "stability", "--out", tmp_path)
    assert ended == code
    assert cases[0][0] in out
    assert f"{len(cases)} cases: " in out


@pytest.mark.parametrize(("case", "method", "run"), hard_scene.cases(), ids=lambda v: v if isinstance(v, str) else "")
def test_a_hard_case_of_an_exercise(case: str, method: str, run: Callable[[], str]) -> None:
    """Its laws are asserted within; a pose that is none must be refused, and everything else must work."""
    bad = case.startswith("poses with") and "denormal place" not in case
    assert run().startswith("refused: " if bad else "ok: ")


def turned(nodes: Array) -> Array:
    """The thread turned by 0.01 rad about its first node, each link as long as it was."""
    return nodes[0] + Rigid(np.zeros(3), quaternion_from_euler_deg((0.0, 0.0, 0.57))).apply(nodes - nodes[0])


def drawn(nodes: Array) -> Array:
    return nodes[0] + (1.0 + 2e-6) * (nodes - nodes[0])


@pytest.mark.parametrize(("change", "law"), [(turned, "leaps"), (drawn, "off its length")])
def test_a_thread_that_breaks_a_law_is_found(change: Callable[[Array], Array], law: str) -> None:
    """Nothing moves it, and it lies elsewhere after the tick; without the change nothing is found."""
    s = scene.build(load_task("anastomosis/single-stitch").task)
    scene_laws.step(s, s.home)
    go = s.step

    def spoilt(poses: ToolPoses) -> tuple[Event, ...]:
        events = go(poses)
        s.world.nodes[:] = change(s.world.nodes)
        return events

    s.step = spoilt  # type: ignore[method-assign]
    with pytest.raises(AssertionError, match=law):
        scene_laws.step(s, s.home)


@pytest.mark.parametrize(
    ("s", "length", "chord", "expected"),
    [(1.0, 4.0, 4.0, 0.0), (2.0, 4.0, 0.0, 2.0), (1.0, 2.0, 1.2, 0.8), (0.5, 2.0, 2.0 - 1e-12, 8.7e-7)],
)
def test_the_slack_of_a_node_between_two_grips(s: float, length: float, chord: float, expected: float) -> None:
    """Taut: none. Grips in one place: the smaller ball. In the middle: a leg of the right triangle 1, 0.6, 0.8.

    Nearly taut, δ short: sqrt(2 δ s (L − s) / L), the sagitta of two flat caps, here 8.66e-7.
    """
    assert scene_laws._farthest(s, length, chord) == pytest.approx(expected, rel=5e-3, abs=1e-12)
