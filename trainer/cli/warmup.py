"""``trainer warmup``: compile the kernels before somebody waits for them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from trainer.anatomy.imported import Anatomy
    from trainer.curriculum import Task


def warmup() -> None:
    """Compile all kernels, by running each task once in memory; later sessions start at once."""
    from dataclasses import replace
    from time import perf_counter

    from trainer.curriculum import family_names, load_family, load_task

    announce()
    begun = perf_counter()
    for family in family_names():
        for name in load_family(family).tasks:
            task = load_task(f"{family}/{name}").task
            warm_up(task)
            if task.scene.thread is not None and not task.scene.thread.drapes:  # a teacher's copy of it may
                warm_up(replace(task, scene=replace(task.scene, thread=replace(task.scene.thread, drapes=True))))
    typer.echo(f"kernels are ready after {perf_counter() - begun:.1f} s, kept in {os.environ['NUMBA_CACHE_DIR']}")


def announce() -> None:
    """Say so on stderr when no kernel has been compiled yet: the first session waits for it."""
    if not any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbi")):
        typer.echo("compiling kernels once, which takes up to a minute…", err=True)


def warm_up(task: Task, anatomy: Anatomy | None = None) -> None:
    """Perform ``task`` with no sinks, so that every kernel is in memory, and every thread there, when the clock starts.

    Kernels are compiled for types and not for sizes: a coarse mesh, long ticks and a hasty hand meet all of them
    in a second or two, whatever becomes of the stitch.
    """
    from dataclasses import replace

    from trainer.clock import Fast
    from trainer.drivers import scripted_hands
    from trainer.mechanics import sharing
    from trainer.profile import Hand
    from trainer.scene import build
    from trainer.session import run

    sharing.start()
    vessels = tuple(replace(vessel, layers=9, around=8) for vessel in task.scene.vessel)
    coarse = replace(task, scene=replace(task.scene, vessel=vessels), tick_hz=20.0)
    scene = build(coarse, anatomy=anatomy)
    run(scene, scripted_hands(Hand(speed_mm_s=30.0), coarse, scene.home, seed=0), [], Fast(coarse.tick_hz))
