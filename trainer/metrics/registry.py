"""The registry: a metric is one small function with a name, a unit and a version.

A name may hold ``{vessel}`` or ``{tool}``: the metric is then taken once for each vessel or instrument of
the task. The function's docstring is the metric's documentation; its first line is shown in reports.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from trainer.config import ConfigError
from trainer.curriculum import MetricTarget, Task
from trainer.log.record import Metric, SessionRecord
from trainer.metrics.performance import Performance

#: Which way a value improves; "" where only a target can tell.
Better = Literal["lower", "higher", ""]

NO_TARGET = "no target"

#: Measures a performance; the second argument is the vessel's or tool's name, "" where there is none.
Measure = Callable[[Performance, str], float | None]


@dataclass(frozen=True)
class Definition:
    """What a metric is."""

    name: str
    unit: str
    version: str
    measure: Measure
    applies: Callable[[Task], bool]
    better: Better

    @property
    def meaning(self) -> str:
        """One line for a reader."""
        return self.documentation.partition("\n")[0]

    @property
    def documentation(self) -> str:
        return inspect.cleandoc(self.measure.__doc__ or "")

    def subjects(self, task: Task) -> list[str]:
        """The vessels or tools of the task that this metric is taken for."""
        if "{vessel}" in self.name:
            return [v.name for v in task.scene.vessel]
        if "{tool}" in self.name:
            return [i.tool for i in task.scene.instrument]
        return [""]


REGISTRY: dict[str, Definition] = {}


def always(task: Task) -> bool:
    return True


def pierces(task: Task) -> bool:
    """Whether the task has a wall to be pierced."""
    return any(s.kind == "drive" for s in task.step)


def joins(task: Task) -> bool:
    """Whether the task has the needle driven into one vessel and out of another."""
    drives = [s for s in task.step if s.kind == "drive"]
    return {s.direction for s in drives} == {"in", "out"} and len({s.vessel for s in drives}) > 1


def metric(
    name: str, unit: str, applies: Callable[[Task], bool] = always, *, better: Better = "", version: str = "1"
) -> Callable[[Measure], Measure]:
    """Registers a function as the metric ``name``. Raises ValueError for a second one of that name."""

    def register(measure: Measure) -> Measure:
        if name in REGISTRY:
            raise ValueError(f"metric '{name}' is registered twice")
        REGISTRY[name] = Definition(name, unit, version, measure, applies, better)
        return measure

    return register


def available(task: Task) -> Iterator[tuple[str, Definition, str]]:
    """(name, definition, subject) of every metric that makes sense for the task, in the registry's order."""
    for definition in REGISTRY.values():
        if definition.applies(task):
            for subject in definition.subjects(task):
                name = definition.name.replace("{vessel}", subject).replace("{tool}", subject)
                yield name, definition, subject


def definition_of(name: str, task: Task) -> Definition:
    """The definition behind a metric's full name. Raises ConfigError when the task has no such metric."""
    known = {n: d for n, d, _ in available(task)}
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        hint = f", did you mean '{near[0]}'?" if near else f"; known: {', '.join(known)}"
        raise ConfigError(f"task '{task.name}': no metric '{name}'{hint}")
    return known[name]


def check_targets(task: Task) -> None:
    """Raises ConfigError when the task wants a metric that it cannot have."""
    for target in task.metric:
        definition_of(target.name, task)


def score(record: SessionRecord, task: Task) -> tuple[Metric, ...]:
    """All metrics of a session, those that the task names first and with its targets.

    A value is finite, or None where the session gave nothing to measure. Raises ConfigError when the task
    names a metric that it cannot have.
    """
    check_targets(task)
    performance = Performance(record, task)
    targets = {t.name: t for t in task.metric}
    measured = {
        name: _row(name, definition, definition.measure(performance, subject), targets.get(name))
        for name, definition, subject in available(task)
    }
    wanted = [measured.pop(name) for name in targets]
    return (*wanted, *measured.values())


def _row(name: str, definition: Definition, value: float | None, target: MetricTarget | None) -> Metric:
    if value is not None and not math.isfinite(value):
        raise ArithmeticError(f"metric '{name}' gave {value}; a metric is finite or None")
    return Metric(
        name=name,
        value=None if value is None else float(value),
        unit=definition.unit,
        target_low=None if target is None else target.low,
        target_high=None if target is None else target.high,
        source=NO_TARGET if target is None else target.source,
        version=definition.version,
    )
