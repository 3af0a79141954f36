"""What a trainee reads after an exercise."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from trainer import curriculum
from trainer.curriculum import Task
from trainer.log.record import Metric
from trainer.metrics.registry import NO_TARGET
from trainer.reporting import wording
from trainer.reporting.session import MetricRow, metric_row


def print_result(result: dict[str, Any], task: Task) -> None:
    """The document of ``practice --json`` as a table of the scores that the task asks for, and what comes next."""
    console = Console(highlight=False, soft_wrap=True, markup=False)
    rows = [metric_row(Metric(**m), task) for m in result["metrics"] if m["source"] != NO_TARGET]
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("measure")
    table.add_column("value", justify="right")
    table.add_column("target")
    table.add_column("")
    for row in rows:
        target = wording.band(row.target_low, row.target_high, row.unit)
        mark = {True: "in", False: "out", None: ""}[row.met]
        table.add_row(
            row.title, wording.quantity(row.value, row.unit), target, mark, style="red" if mark == "out" else ""
        )
    pace = result["realtime"]
    console.print(
        f"{task.title}: {result['outcome']} after {wording.duration(result['duration_s'])}, {result['reason']}"
    )
    console.print(table)
    if result["out_of_sight"]:
        console.print(f"out of sight   {result['out_of_sight']}; what moved meanwhile is in the scores", style="red")
    console.print(f"work per tick  median {pace['p50_ms']:.2f} ms, 99 % within {pace['p99_ms']:.2f} ms")
    console.print(f"methods        {_methods(result['methods'])}")
    console.print(f"session        {result['session']} in {result['log']}")
    if result["recording"] is not None:
        console.print(f"recording      {result['recording']}")
    console.print(f"next           {suggestion(result['task'], result['outcome'], rows)}")


def _methods(methods: dict[str, Any]) -> str:
    """What moved the tissue and the thread, in a line."""
    tissue, thread, region = methods["tissue"], methods["thread"], methods["region"]
    said = []
    if tissue is not None:
        said.append(f"tissue by {tissue['method']} to {tissue['tolerance_mN']:.2g} mN")
        if tissue["cheapest"]["method"] != tissue["method"]:
            said[0] += f" ({tissue['cheapest']['method']} would be cheaper, but cannot run in a scene)"
    if thread is not None:
        said.append(f"thread by {thread['method']}")
    if region is not None:
        said.append(f"tissue by {region['method']}")
    return "; ".join(said) or "none"


def suggestion(reference: str, outcome: str, rows: list[MetricRow]) -> str:
    """What to practise next: the same task until it is completed with every score in its target, then the next."""
    if outcome != "completed":
        return f"{reference} again: it was not completed"
    missed = [row.title.lower() for row in rows if row.met is False]
    if missed:
        return f"{reference} again, with an eye on {', '.join(missed)}"
    family, _, name = reference.partition("/")
    tasks = curriculum.load_family(family).tasks if family in curriculum.family_names() else ()
    later = tasks[tasks.index(name) + 1 :] if name in tasks else ()
    return f"{family}/{later[0]}" if later else f"{reference} again, faster and with less movement"
