"""The line that shows how far an exercise is; nothing where stderr is no terminal."""

from __future__ import annotations

import rich.progress
from rich.console import Console

from trainer.curriculum import Task
from trainer.sinks.surface import TickRecord


class Progress:
    """A sink that keeps one line on stderr; rich redraws it four times a second from a thread of its own."""

    def __init__(self, task: Task) -> None:
        console = Console(stderr=True)
        self._steps = task.step
        self._done = 0
        self._every = max(1, round(task.tick_hz / 4))
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.completed:6.1f} s"),
            rich.progress.BarColumn(),
            rich.progress.TextColumn("{task.description}"),
            console=console,
            refresh_per_second=4,
            transient=True,
            disable=not console.is_terminal,
        )
        self._line = self._bar.add_task(self._steps[0].name, total=task.time_limit_s)
        self._bar.start()

    def tick(self, record: TickRecord) -> None:
        reached = sum(event.kind == "step_done" for event in record.events)
        if not reached and record.tick % self._every:
            return
        self._done += reached
        here = self._steps[min(self._done, len(self._steps) - 1)].name
        step = f"step {min(self._done + 1, len(self._steps))} of {len(self._steps)}: {here}"
        self._bar.update(self._line, completed=record.time_s, description=step)

    def close(self) -> None:
        self._bar.stop()
