"""``trainer warmup``: compile the kernels before somebody waits for them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from trainer.curriculum import Task


def warmup() -> None:
    """Compile all kernels, by running each task once in memory; later sessions start at once."""
    from time import perf_counter

    from trainer.curriculum import family_names, load_family, load_task

    announce()
    begun = perf_counter()
    for family in family_names():
        for name in load_family(family).tasks:
            warm_up(load_task(f"{family}/{name}").task)
    typer.echo(f"kernels are ready after {perf_counter() - begun:.1f} s, kept in {os.environ['NUMBA_CACHE_DIR']}")


def announce() -> None:
    """Say so on stderr when no kernel has been compiled yet: the first session waits for it."""
    if not any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbi")):
        typer.echo("compiling kernels once, which takes about a minute…", err=True)


def warm_up(task: Task) -> None:
    """Run ``task`` with a scripted hand and no sinks, so that every kernel is in memory when the clock starts."""
    from trainer.clock import Fast
    from trainer.drivers import open_driver
    from trainer.scene import build
    from trainer.session import run

    scene = build(task)
    _, driver = open_driver("scripted-expert", task, scene.home, seed=0)
    run(scene, driver, [], Fast(task.tick_hz))
    driver.close()
