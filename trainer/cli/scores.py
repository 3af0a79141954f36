"""What a trainee reads after an exercise."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from trainer import curriculum
from trainer.cli.curricula import band


def print_result(result: dict[str, Any]) -> None:
    """The document of ``practice --json`` as a table of scores, and what to do next."""
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{result['task']}: {result['outcome']} after {result['duration_s']:.2f} s ({result['reason']})")
    table = Table()
    table.add_column("score")
    table.add_column("value", justify="right")
    table.add_column("unit")
    table.add_column("target")
    table.add_column("")
    for metric in result["metrics"]:
        within = in_target(metric)
        table.add_row(
            metric["name"],
            "–" if metric["value"] is None else f"{metric['value']:.4g}",
            metric["unit"],
            target(metric),
            "" if within is None else "[green]in[/green]" if within else "[red]out[/red]",
        )
    console.print(table)
    pace = result["realtime"]
    console.print(f"work per tick: median {pace['p50_ms']:.2f} ms, 99 % within {pace['p99_ms']:.2f} ms")
    console.print(f"log:       {result['log']}, session {result['session']}")
    if result["recording"] is not None:
        console.print(f"recording: {result['recording']}")
    console.print(f"next:      {suggestion(result)}")


def in_target(metric: dict[str, Any]) -> bool | None:
    """Whether a score lies in its target band; None without a band or a value."""
    value, low, high = metric["value"], metric["target_low"], metric["target_high"]
    if value is None or (low is None and high is None):
        return None
    return (low is None or value >= low) and (high is None or value <= high)


def target(metric: dict[str, Any]) -> str:
    low, high = metric["target_low"], metric["target_high"]
    return "" if low is None and high is None else band(low, high)


def suggestion(result: dict[str, Any]) -> str:
    """What to practise next: the same until it is completed with every score in its target, then the next task."""
    task = result["task"]
    if result["outcome"] != "completed":
        return f"{task} again: it was not completed"
    missed = [f"{m['name']} ({target(m)})" for m in result["metrics"] if in_target(m) is False]
    if missed:
        return f"{task} again, with an eye on {', '.join(missed)}"
    family, _, name = task.partition("/")
    if family in curriculum.family_names():
        tasks = curriculum.load_family(family).tasks
        later = tasks[tasks.index(name) + 1 :] if name in tasks else ()
        if later:
            return f"{family}/{later[0]}"
    return f"{task} again, faster and with less movement"
