"""Reports on the terminal: the same model as the page, in tables that fit 80 columns."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from trainer.reporting import wording
from trainer.reporting.progress import Curve, ProgressReport, TaskProgress
from trainer.reporting.session import MetricRow, SessionReport
from trainer.reporting.summary import curve_words, session_summary, task_summary

#: Cells of a target strip.
_CELLS = 20


def print_session(report: SessionReport, console: Console) -> None:
    """One session: outcome, targets, bites, everything else that was measured, events."""
    console.print(f"[bold]{escape(report.task_title)}[/bold]  {escape(report.outcome)}")
    console.print(
        f"{escape(report.trainee)}, {wording.date(report.started_at)}, {wording.duration(report.duration_s)}, "
        f"{report.steps_done} of {report.steps} steps, {escape(report.device)}, session {escape(report.session)}"
    )
    console.print(f"{escape(session_summary(report))}\n")
    console.print(_targets(report.targets))
    _print_bites(report, console)
    _print_others(report.others, console)
    events = Table("time", "hand", "event", "", box=None, pad_edge=False, header_style="dim")
    events.columns[0].justify = "right"
    for e in report.events:
        times = f" × {e.count}" if e.count > 1 else ""
        events.add_row(f"{e.time_s:.2f} s", escape(e.tool), wording.kind_word(e.kind), escape(e.text) + times)
    console.print(events)
    _print_notes([r for r in report.targets if r.assumed], console)


def print_progress(report: ProgressReport, console: Console) -> None:
    """A trainee's attempts at each task."""
    console.print(f"[bold]{escape(report.trainee)}[/bold]")
    for task in report.tasks:
        console.print(f"\n[bold]{escape(task.title)}[/bold]\n{escape(task_summary(task))}")
        for curve in task.curves:
            console.print(f"  {curve.title:<18} {spark(curve)}  {escape(curve_words(curve))}")
        console.print(_progress(task))
    assumed = {r.last.source: r.last for t in report.tasks for r in t.rows if r.last.assumed}
    _print_notes(list(assumed.values()), console)


def spark(curve: Curve, most: int = 24) -> str:
    """The last values as blocks of eight heights, from 0 to the largest."""
    values = curve.values[-most:]
    top = max(values, default=0.0)
    if top <= 0.0:
        return "▁" * len(values)
    return "".join("▁▂▃▄▅▆▇█"[max(round(8.0 * v / top) - 1, 0)] for v in values)


def strip(row: MetricRow) -> str:
    """The target band as a bar on a scale, and the value's place on it."""
    limits = [v for v in (row.target_low, row.target_high) if v is not None]
    seen = [] if row.value is None else [row.value]
    low = min(0.0, *limits, *seen)
    high = 90.0 if row.unit == "deg" else max(1.25 * max([*limits, *seen]), 1.0 if row.unit == "count" else 1e-9)

    def cell(value: float) -> int:
        return min(max(int((value - low) / (high - low) * _CELLS), 0), _CELLS - 1)

    first = cell(low if row.target_low is None else row.target_low)
    last = cell(high if row.target_high is None else row.target_high)
    cells = ["━" if first <= i <= last else "·" for i in range(_CELLS)]
    if row.value is not None:
        cells[cell(row.value)] = "●" if row.met else "◆"
    return "".join(cells)


def _targets(rows: tuple[MetricRow, ...]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("measure")
    table.add_column("value", justify="right")
    for name in ("", "target", ""):
        table.add_column(name)
    for row in rows:
        target = wording.band(row.target_low, row.target_high, row.unit)
        table.add_row(row.title, wording.quantity(row.value, row.unit), strip(row), target, _verdict(row))
    return table


def _verdict(row: MetricRow) -> str:
    if row.met is None:
        return "[dim]not measured[/dim]" if row.has_target else ""
    return "[green]met[/green]" if row.met else "[bold red]missed[/bold red]"


def _print_bites(report: SessionReport, console: Console) -> None:
    if not report.stitch_map.bites:
        return
    table = Table("vessel", "clock", "bite", "from upright", "pass", "", box=None, pad_edge=False, header_style="dim")
    for column in table.columns[1:5]:
        column.justify = "right"
    for b in report.stitch_map.bites:
        error = wording.quantity(b.angle_error_deg, "deg")
        left = "" if b.kept else "left again"
        table.add_row(b.vessel, f"{b.clock_deg:.0f}°", f"{b.bite_mm:.2f} mm", error, str(b.pass_number), left)
    console.print(table)
    console.print()


def _print_others(rows: tuple[MetricRow, ...], console: Console) -> None:
    table = Table(box=None, pad_edge=False, show_header=False)
    for _ in range(2):
        table.add_column(style="dim")
        table.add_column(justify="right")
    cells = [(r.title, wording.quantity(r.value, r.unit)) for r in rows]
    half = (len(cells) + 1) // 2
    for i in range(half):
        right = cells[half + i] if half + i < len(cells) else ("", "")
        table.add_row(*cells[i], *right)
    console.print(table)
    console.print()


def _progress(task: TaskProgress) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("measure")
    table.add_column("last", justify="right")
    table.add_column("best", justify="right")
    for name in ("", "target", ""):
        table.add_column(name)
    for row in task.rows:
        last = row.last
        bar = strip(last) if last.has_target else ""
        target = wording.band(last.target_low, last.target_high, last.unit) or "[dim]no target[/dim]"
        value, best = wording.quantity(last.value, last.unit), wording.quantity(row.best, last.unit)
        table.add_row(last.title, value, best, bar, target, _verdict(last))
    return table


def _print_notes(assumed: list[MetricRow], console: Console) -> None:
    console.print()
    for row in assumed:
        console.print(f"[dim]{row.title}: {escape(row.source)}[/dim]", soft_wrap=True)
    console.print(f"[dim]{wording.DISCLAIMER}[/dim]")
