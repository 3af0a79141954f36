"""What holds for every metric by existing: finite or None, documented, moved with the world, in the task's order."""

from __future__ import annotations

import dataclasses
import math
import typing

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.synthetic_session import (
    DRIVE,
    LANDMARKS,
    LIGAMENT,
    STITCH,
    landmarks,
    ligament,
    performed,
    record,
    stitch,
    task_of,
)
from trainer.config import ConfigError
from trainer.curriculum import MetricTarget, family_names, load_family
from trainer.events import KINDS, Event, Vector
from trainer.geometry import Rigid, unit
from trainer.log.record import SessionRecord
from trainer.metrics import FAMILIES, REGISTRY, Definition, available, score
from trainer.metrics.registry import NO_TARGET

UNITS = {"deg", "mm", "mm3", "s", "mN", "count", "ratio"}
TASKS = [f"{family}/{task}" for family in family_names() for task in load_family(family).tasks]

NUMBERS = st.floats(-1e6, 1e6)
WORDS = {
    "body": st.sampled_from(["A", "B", "", "C"]),
    "wall": st.sampled_from(["outer", "inner"]),
    "direction": st.sampled_from(["in", "out"]),
    "target": st.sampled_from(["needle", "thread", "wall", "tissue"]),
}


def kind_of_event(cls: type[Event]) -> st.SearchStrategy[Event]:
    """Any event of one kind with finite numbers, sensible or not."""
    by_type: dict[object, st.SearchStrategy[object]] = {
        int: st.integers(-1, 20), float: NUMBERS, str: st.text(max_size=5), Vector: st.tuples(*[NUMBERS] * 3),
    }  # fmt: skip
    hints = {k: v for k, v in typing.get_type_hints(cls).items() if k not in ("kind", "simulated")}
    fields: dict[str, st.SearchStrategy[object]] = {k: WORDS.get(k, by_type[v]) for k, v in hints.items()}
    fields |= {
        "tick": st.integers(0, 500), "seq": st.integers(0, 3), "time_s": st.floats(0.0, 5.0),
        "tool": st.sampled_from(["left", "right", ""]),
    }  # fmt: skip
    return st.builds(cls, **fields)  # type: ignore[arg-type]


EVENTS = st.lists(st.one_of([kind_of_event(cls) for cls in KINDS.values()]), max_size=40)


RATES = st.sampled_from([10.0, 50.0, 100.0])


@given(EVENTS, st.integers(0, 300), st.integers(0, 2**32 - 1), st.sampled_from(TASKS), RATES)
@settings(max_examples=100, deadline=None)
def test_any_log_gives_finite_scores(events: list[Event], ticks: int, seed: int, task: str, tick_hz: float) -> None:
    rng = np.random.default_rng(seed)
    made = record(
        tuple(events), reference=task, right=rng.normal(0.0, 100.0, (ticks, 3)),
        valid=rng.random((ticks, 2)) < 0.7, tick_hz=tick_hz,
    )  # fmt: skip
    for m in score(made, task_of(task)):
        assert m.value is None or math.isfinite(m.value), m.name


@pytest.mark.parametrize("task", TASKS)
def test_an_empty_session_scores(task: str) -> None:
    for m in score(record(reference=task), task_of(task)):
        assert m.value is None or math.isfinite(m.value), m.name


@pytest.mark.parametrize("definition", REGISTRY.values(), ids=list(REGISTRY))
def test_every_metric_says_what_it_is(definition: Definition) -> None:
    assert definition.unit in UNITS
    assert definition.version
    assert definition.meaning.endswith(".")
    assert len(definition.meaning) <= 120
    suffix = {"deg": "_deg", "mm": "_mm", "mm3": "_mm3", "s": "_s", "mN": "_mN"}.get(definition.unit, "")
    assert definition.name.endswith(suffix)
    assert definition.measure.__module__ in {family.__name__ for family in FAMILIES}


@pytest.mark.parametrize("definition", REGISTRY.values(), ids=list(REGISTRY))
def test_every_metric_has_a_value_on_a_whole_performance(definition: Definition) -> None:
    """So that no metric is silently None for ever; placement and all others exist on a finished stitch."""
    whole = ((performed(seed=1), task_of()), (ligament(), task_of(LIGAMENT)), (landmarks(), task_of(LANDMARKS)))
    made, task = next((made, task) for made, task in whole if definition.applies(task))
    values = {m.name: m.value for m in score(made, task)}
    names = [n for n, d, _ in available(task) if d is definition]
    assert names
    if definition.name not in {"economy_{tool}"}:  # the left hand does one thing only
        assert all(values[n] is not None for n in names)


def test_the_tasks_metrics_come_first_with_their_targets() -> None:
    task = task_of()
    found = score(performed(), task)
    assert [m.name for m in found[: len(task.metric)]] == [t.name for t in task.metric]
    for m, t in zip(found, task.metric, strict=False):
        assert (m.target_low, m.target_high, m.source) == (t.low, t.high, t.source)
    for m in found[len(task.metric) :]:
        assert (m.target_low, m.target_high, m.source) == (None, None, NO_TARGET)
    assert len({m.name for m in found}) == len(found)


def test_a_task_without_a_second_end_has_no_stitch_metrics() -> None:
    names = {m.name for m in score(record(reference=DRIVE), task_of(DRIVE))}
    assert "bite_A_mm" in names
    assert not names & {"bite_B_mm", "bite_asymmetry", "side_mismatch_mm", "break_count"}


def test_an_unknown_metric_is_named_with_the_nearest_known_one() -> None:
    task = dataclasses.replace(task_of(), metric=(MetricTarget("entry_angel_deg", "typo"),))
    with pytest.raises(ConfigError, match=r"no metric 'entry_angel_deg', did you mean 'entry_angle_deg'\?"):
        score(record(), task)


def moved(made: SessionRecord, world: Rigid) -> SessionRecord:
    """The session as it would have been logged in a world that is moved and turned."""

    def carry(event: Event) -> Event:
        changed = {}
        for field in dataclasses.fields(event):
            value = getattr(event, field.name)
            if isinstance(value, tuple):
                turned = field.name in ("tangent", "normal", "needle_tangent")
                changed[field.name] = tuple((world.rotate(value) if turned else world.apply(value)).tolist())
        return dataclasses.replace(event, **changed)

    return dataclasses.replace(made, events=tuple(carry(e) for e in made.events), position=world.apply(made.position))


@given(
    st.tuples(*[st.floats(-1000.0, 1000.0)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 0.1),
)
@settings(max_examples=25, deadline=None)
def test_scores_do_not_depend_on_where_the_scene_stands(
    position: tuple[float, ...], quaternion: tuple[float, ...]
) -> None:
    """A rigid motion by up to 1.7 m changes no value by more than 1e-9 of it.

    Coordinates of 1e3 mm carry rounding of 1e-13 mm; a path of 4000 ticks adds 4e-10 mm at most.
    """
    made = performed(seed=2)
    world = Rigid(np.array(position), unit(quaternion))
    for before, after in zip(score(made, task_of()), score(moved(made, world), task_of()), strict=True):
        if before.value is None:
            assert after.value is None
        else:
            assert after.value == pytest.approx(before.value, rel=1e-9, abs=1e-9), before.name


def test_scores_are_bit_identical_from_run_to_run() -> None:
    assert score(performed(seed=4), task_of()) == score(performed(seed=4), task_of())


def test_a_vessel_that_the_task_does_not_know_is_ignored() -> None:
    made = record(tuple(stitch()), reference=STITCH)
    found = {m.name: m.value for m in score(made, task_of(DRIVE))}
    assert found["bite_A_mm"] == 0.35
