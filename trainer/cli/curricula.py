"""``trainer curricula``: what can be practised, and whether a curriculum's files are in order."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from trainer.curriculum import Family, Task, TaskFile

app = typer.Typer(help="What can be practised.", no_args_is_help=True)

JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


@app.command("list")
def list_(as_json: JsonOption = False) -> None:
    """List the families and their tasks, in the order in which a trainee meets them."""
    from trainer import curriculum

    families = [curriculum.load_family(name) for name in curriculum.family_names()]
    if as_json:
        print(json.dumps([_family_json(f) for f in families], indent=2))
        return
    for family in families:
        _print_family(family)


@app.command()
def show(
    reference: Annotated[str, typer.Argument(metavar="FAMILY[/TASK]", help="A family, a task or a task's .toml file.")],
    as_json: JsonOption = False,
) -> None:
    """Show a family, or a task's steps, limits, targets and components with their sources."""
    from trainer import curriculum

    if "/" not in reference and not reference.endswith(".toml"):
        family = curriculum.load_family(reference)
        if as_json:
            print(json.dumps(_family_json(family), indent=2))
        else:
            _print_family(family)
        return
    task_file = curriculum.load_task(reference)
    if as_json:
        print(json.dumps(_task_json(task_file), indent=2))
    else:
        _print_task(reference, task_file.task)


@app.command()
def check(
    path: Annotated[Path, typer.Argument(help="A task file, a curriculum.toml or a folder of them.")],
    as_json: JsonOption = False,
) -> None:
    """Check files of a curriculum; exit code 1 when something is wrong."""
    from trainer import curriculum
    from trainer.choice import beyond, choose_tissue, overfull
    from trainer.metrics.registry import check_targets
    from trainer.scene import build

    def check_task(task: curriculum.Task) -> None:
        check_targets(task)
        tissue = choose_tissue(task, task.name)
        for doubt in filter(None, (beyond(tissue), overfull(task, tissue))):
            typer.echo(f"task '{task.name}': {doubt}", err=True)
        build(task)

    problems = curriculum.check(path, check_task)
    if as_json:
        print(json.dumps({"path": str(path), "problems": problems}, indent=2))
    elif problems:
        for problem in problems:
            typer.echo(problem, err=True)
    else:
        print(f"{path}: in order")
    if problems:
        raise typer.Exit(1)


def _family_json(family: Family) -> dict[str, Any]:
    from trainer import curriculum

    tasks = [curriculum.load_task(f"{family.name}/{name}").task for name in family.tasks]
    return {
        "family": family.name,
        "title": family.title,
        "summary": family.summary,
        "tasks": [{"task": f"{family.name}/{t.name}", "title": t.title, "summary": t.summary} for t in tasks],
    }


def _task_json(task_file: TaskFile) -> dict[str, Any]:
    import dataclasses

    return {"reference": task_file.path, "sha256": task_file.sha256, **dataclasses.asdict(task_file.task)}


def _print_family(family: Family) -> None:
    shown = _family_json(family)
    print(f"{family.title}: {family.summary}")
    for task in shown["tasks"]:
        print(f"  {task['task']:<30} {task['title']}")


def _print_task(reference: str, task: Task) -> None:
    from trainer.metrics.registry import definition_of
    from trainer.reporting import wording

    print(f"{reference}: {task.title}\n{task.summary}")
    print(f"Ends after {task.time_limit_s:g} s at most; {task.tick_hz:g} ticks per second.")
    print("\nSteps")
    for number, step in enumerate(task.step, 1):
        print(f"  {number}. {step.name}")
    print("\nLimits")
    for name, limit in task.limits.items():
        print(f"  {name}: {limit.value:g} {limit.unit}  [{limit.source}]")
    budget = task.solver
    if task.scene.vessel:
        print(f"\nTissue\n  right to {budget.node_error_mm:g} mm and {budget.force_error_mN:g} mN of unbalanced force")
    print("\nMeasured")
    for metric in task.metric:
        target = wording.band(metric.low, metric.high, definition_of(metric.name, task).unit) or "no target"
        print(f"  {metric.name}: {target}  [{metric.source}]")
    print("\nScene")
    scene = task.scene
    for vessel in scene.vessel:
        _print_component(f"vessel {vessel.name}", vessel)
    if scene.needle is not None:
        _print_component("needle", scene.needle)
    if scene.thread is not None:
        _print_component("thread", scene.thread)
    if scene.anatomy is not None:
        if scene.anatomy.knee is not None:
            _print_component("knee", scene.anatomy.knee)
        else:
            print(f"  section {scene.anatomy.section}")
        if scene.anatomy.hardness_mN_per_mm is not None:
            hardness = scene.anatomy.hardness_mN_per_mm
            print(f"  hardness_mN_per_mm = {hardness.value:g}  [{hardness.source}]")
        for tissue in scene.anatomy.tissue:
            _print_component(tissue.structure, tissue)
    for instrument in scene.instrument:
        _print_component(f"instrument {instrument.tool}", instrument)


def _print_component(title: str, component: Any) -> None:
    import dataclasses

    from trainer.config import Sourced

    print(f"  {title}")
    for field in dataclasses.fields(component):
        value = getattr(component, field.name)
        if isinstance(value, Sourced):
            print(f"    {field.name} = {value.value:g}  [{value.source}]")
        else:
            print(f"    {field.name} = {value}")
