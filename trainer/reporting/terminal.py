"""Reports on the terminal: the same model as the page; a narrow terminal loses figures, never a value."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from trainer.reporting import wording
from trainer.reporting.progress import Curve, ProgressReport, ProgressRow, TaskProgress
from trainer.reporting.session import Bite, MetricRow, SessionReport
from trainer.reporting.summary import NOT_ASKED, curve_words, session_summary, task_summary, tissue_columns

#: Cells of a target strip.
_CELLS = 20

#: Heading of the column of strips, the one that a table can do without.
_STRIP = "scale"


def print_session(report: SessionReport, console: Console) -> None:
    """One session: outcome, targets, bites, everything else that was measured, events."""
    title = wording.within(report.task_title, report.anatomy)
    console.print(f"[bold]{escape(title)}[/bold]  {escape(report.outcome)}")
    console.print(
        f"{escape(report.trainee)}, {wording.date(report.started_at)}, {wording.duration(report.duration_s)}, "
        f"{report.steps_done} of {report.steps} steps, {escape(report.device)}, session {escape(report.session)}"
    )
    console.print(f"{escape(session_summary(report))}\n")
    _print_targets(report.targets, console)
    _print_bites(report, console)
    _print_tissue(report, console)
    _print_others(report.others, console)
    events = Table("time", "hand", "event", "", box=None, pad_edge=False, header_style="dim")
    events.columns[0].justify = "right"
    events.columns[0].no_wrap = True
    for column in events.columns[1:]:
        column.overflow = "fold"
    for e in report.events:
        times = f" × {e.count}" if e.count > 1 else ""
        events.add_row(f"{e.time_s:.2f} s", escape(e.tool), wording.kind_word(e.kind), escape(e.text) + times)
    console.print(events)
    _print_notes([r for r in report.targets if r.assumed], console)


def print_progress(report: ProgressReport, console: Console) -> None:
    """A trainee's attempts at each task."""
    console.print(f"[bold]{escape(report.trainee)}[/bold]")
    for task in report.tasks:
        title = wording.within(task.title, task.anatomy)
        console.print(f"\n[bold]{escape(title)}[/bold]\n{escape(task_summary(task))}")
        width = max((len(curve.title) for curve in task.curves), default=0)
        for curve in task.curves:
            console.print(f"  {curve.title:<{width}} {spark(curve)}  {escape(curve_words(curve))}")
        _print_progress(task, console)
    if report.several_knees:
        console.print(f"\n{wording.KNEES_APART}")
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


def _print_rows(head: Sequence[tuple[str, str]], rows: Sequence[Sequence[str]], console: Console) -> None:
    """A table, without its strips where they do not fit; line by line where it does not fit without them either.

    ``head`` holds each column's heading and whether its cells stand left or right.
    """
    bare = [i for i, (name, _) in enumerate(head) if name != _STRIP]
    for shown in (range(len(head)), bare):
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        for i in shown:
            name, justify = head[i]
            table.add_column("" if name == _STRIP else name, justify="right" if justify == "right" else "left")
        for row in rows:
            table.add_row(*(row[i] for i in shown))
        if _fits(table, console):
            console.print(table)
            return
    for row in rows:
        cells = [f"{head[i][0]} {row[i]}".strip() for i in bare[1:] if row[i]]
        console.print(f"{row[0]}: {', '.join(cells)}")
    console.print()


def _fits(table: Table, console: Console) -> bool:
    """Whether no cell of the table has to be cut or wrapped."""
    unlimited = console.options.update(width=10_000)
    return Measurement.get(console, unlimited, table).maximum <= console.width


def _print_targets(rows: tuple[MetricRow, ...], console: Console) -> None:
    head = (("measure", "left"), ("value", "right"), (_STRIP, "left"), ("target", "left"), ("", "left"))

    def cells(row: MetricRow) -> list[str]:
        target = wording.band(row.target_low, row.target_high, row.unit)
        return [escape(row.title), wording.quantity(row.value, row.unit), strip(row), target, _verdict(row)]

    _print_rows(head, [cells(r) for r in rows], console)


def _verdict(row: MetricRow) -> str:
    if row.met is None:
        return "[dim]not measured[/dim]" if row.has_target else ""
    return "[green]met[/green]" if row.met else "[bold red]missed[/bold red]"


def _print_bites(report: SessionReport, console: Console) -> None:
    if not report.stitch_map.bites:
        return
    names = ("clock", "bite", "from upright", "pass")
    head = (("vessel", "left"), *((name, "right") for name in names), ("", "left"))

    def cells(b: Bite) -> list[str]:
        error = wording.quantity(b.angle_error_deg, "deg")
        place = [escape(b.vessel), wording.clock(b.clock_deg), f"{b.bite_mm:.2f} mm"]
        return [*place, error, str(b.pass_number), "" if b.kept else "left again"]

    _print_rows(head, [cells(b) for b in report.stitch_map.bites], console)


def _print_tissue(report: SessionReport, console: Console) -> None:
    if not report.tissue:
        return
    columns = tissue_columns(report.tissue)
    names = [escape(r.structure) + ("" if r.asked else f" [bold red]{NOT_ASKED}[/bold red]") for r in report.tissue]
    head = (("structure", "left"), *((name, "right") for name in columns))
    _print_rows(head, list(zip(names, *columns.values(), strict=True)), console)


def _print_others(rows: tuple[MetricRow, ...], console: Console) -> None:
    cells = [(escape(r.title), wording.quantity(r.value, r.unit)) for r in rows]
    half = (len(cells) + 1) // 2
    beside = [(*cells[i], *(cells[half + i] if half + i < len(cells) else ("", ""))) for i in range(half)]
    table = _pairs(beside, 2)
    if not _fits(table, console):
        table = _pairs(cells, 1)
    console.print(table)
    console.print()


def _pairs(rows: Sequence[Sequence[str]], beside: int) -> Table:
    """Names and values, so many pairs beside each other; only a name is ever folded."""
    table = Table(box=None, pad_edge=False, show_header=False)
    for _ in range(beside):
        table.add_column(style="dim", overflow="fold")
        table.add_column(justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _print_progress(task: TaskProgress, console: Console) -> None:
    head = (("measure", "left"), ("last", "right"), ("best", "right"), (_STRIP, "left"), ("target", "left"),
            ("", "left"))  # fmt: skip

    def cells(row: ProgressRow) -> list[str]:
        last = row.last
        bar = strip(last) if last.has_target else ""
        target = wording.band(last.target_low, last.target_high, last.unit) or "[dim]none[/dim]"
        value, best = wording.quantity(last.value, last.unit), wording.quantity(row.best, last.unit)
        return [escape(last.title), value, best, bar, target, _verdict(last)]

    _print_rows(head, [cells(r) for r in task.rows], console)


def _print_notes(assumed: list[MetricRow], console: Console) -> None:
    console.print()
    for row in assumed:
        console.print(f"[dim]{row.title}: {escape(row.source)}[/dim]", soft_wrap=True)
    console.print(f"[dim]{wording.DISCLAIMER}[/dim]")
