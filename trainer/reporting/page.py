"""Reports as one HTML file each: no script, nothing fetched, figures inline, fit for A4 paper.

The text around the figures lives in ``reports/templates``; every name that came from a person or a log is
escaped on its way into it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby
from string import Template

from trainer.config import read_text
from trainer.data_files import data_folder
from trainer.reporting import figures, wording
from trainer.reporting.progress import Attempt, Curve, ProgressReport, ProgressRow, TaskProgress
from trainer.reporting.session import EventLine, Histogram, MetricRow, SessionReport, StitchMap, TissueRow
from trainer.reporting.summary import NOT_ASKED, curve_words, session_summary, task_summary, tissue_columns

MAP_CAPTION = (
    "Each vessel end around its cut edge, 3 o'clock on the same side of both. Distance from the inner circle is the "
    "bite in mm; the number is the pass; a dot with a dashed edge was left again."
)
COMPLETED_ONLY = (
    "Curves and best values count completed attempts only; the others stopped at another place. In a curve the thick "
    "line is the median of the last three, the dashed one the slope."
)


class Sources:
    """The sources of the targets, numbered in the order in which they are first cited."""

    def __init__(self) -> None:
        self.listed: list[str] = []

    def cite(self, row: MetricRow) -> str:
        """The reference to a row's source, and whether it is only assumed."""
        if not row.source:
            return ""
        if row.source not in self.listed:
            self.listed.append(row.source)
        number = self.listed.index(row.source) + 1
        assumed = " assumed" if row.assumed else ""
        return f'<a href="#source-{number}">[{number}]</a>{assumed}'

    def footnotes(self) -> str:
        items = [f'<li id="source-{i}">{escape(s)}</li>' for i, s in enumerate(self.listed, 1)]
        return f"<p>Where the targets come from:</p><ol>{''.join(items)}</ol>" if items else ""


def session_page(report: SessionReport) -> str:
    """The report of one session. Raises ConfigError when a template is missing."""
    sources = Sources()
    targets = _target_table(report.targets, sources)
    return _fill(
        "session.html",
        page_title=escape(f"{wording.within(report.task_title, report.anatomy)}, {report.trainee}"),
        style=_template("style.css").template,
        task_title=escape(report.task_title),
        outcome=escape(report.outcome),
        steps=f"{report.steps_done} of {report.steps} steps",
        facts=_facts(
            ("Trainee", report.trainee),
            ("Date", wording.date(report.started_at)),
            ("Duration", wording.duration(report.duration_s)),
            ("Device", report.device),
            ("Task", report.task),
            *((("Knee", report.anatomy),) if report.anatomy else ()),
            ("Session", report.session),
        ),
        summary=escape(session_summary(report)),
        **_where(report.stitch_map, report.histogram, report.tissue, "", ""),
        targets=targets,
        others=_other_groups(report.others),
        events=_event_table(report.events),
        footer=sources.footnotes() + _definitions(report.targets) + _closing(report.versions, report.overruns),
    )


def progress_page(report: ProgressReport) -> str:
    """The report of a trainee's progress. Raises ConfigError when a template is missing."""
    sources = Sources()
    tasks = "".join(_task_section(t, sources) for t in report.tasks)
    attempts = sum(len(t.attempts) for t in report.tasks)
    notes = [COMPLETED_ONLY] + ([wording.KNEES_APART] if report.several_knees else [])
    first, last = (wording.date(t).partition(",")[0] for t in (report.first_at, report.last_at))
    return _fill(
        "progress.html",
        page_title=escape(f"Progress of {report.trainee}"),
        style=_template("style.css").template,
        trainee=escape(report.trainee),
        count=f"{attempts} session{'s' if attempts != 1 else ''}",
        period=first if first == last else f"{first} to {last}",
        tasks=tasks,
        footer=sources.footnotes() + f"<p>{' '.join(notes)}</p>" + _closing({}, 0),
    )


def _template(name: str) -> Template:
    return Template(read_text(data_folder("reports") / "templates" / name))


def _fill(name: str, **parts: str) -> str:
    return _template(name).substitute(parts)


def _facts(*pairs: tuple[str, str]) -> str:
    return "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in pairs)


def _table(head: Sequence[tuple[str, str]], rows: Iterable[Sequence[str]], style: str = "") -> str:
    """A table; ``head`` holds each column's heading and class. Cells are HTML already."""

    def cell(tag: str, kind: str, content: str) -> str:
        return f'<{tag} class="{kind}">{content}</{tag}>' if kind else f"<{tag}>{content}</{tag}>"

    top = "".join(cell("th", kind, escape(name)) for name, kind in head)
    kinds = [kind for _, kind in head]
    body = "".join(f"<tr>{''.join(cell('td', k, c) for k, c in zip(kinds, row, strict=True))}</tr>" for row in rows)
    thead = f"<thead><tr>{top}</tr></thead>" if any(name for name, _ in head) else ""
    return f'<table class="{style}">{thead}<tbody>{body}</tbody></table>'


def _verdict(row: MetricRow) -> str:
    if row.met is None:
        return '<span class="quiet">not measured</span>'
    return '<span class="met">met</span>' if row.met else '<span class="missed">missed</span>'


def _target_table(rows: tuple[MetricRow, ...], sources: Sources) -> str:
    head = (("Measure", ""), ("Value", "n"), ("", ""), ("Target", ""), ("Source", "quiet"), ("", ""))
    return _table(
        head,
        ([_named(r), _value(r), figures.strip(r), _target(r), sources.cite(r), _verdict(r)] for r in rows),
    )


def _named(row: MetricRow) -> str:
    return f'<span title="{escape(row.meaning)}">{escape(row.title)}</span>'


def _value(row: MetricRow) -> str:
    return f"<strong>{escape(wording.quantity(row.value, row.unit))}</strong>"


def _target(row: MetricRow) -> str:
    if not row.has_target:
        return '<span class="quiet">no target</span>'
    return escape(wording.band(row.target_low, row.target_high, row.unit))


def _other_groups(rows: tuple[MetricRow, ...]) -> str:
    order = {"Needle": 0, "Stitch": 1, "Tissue": 2, "Motion": 3, "Handling": 4}
    parts = []
    for family, group in groupby(sorted(rows, key=lambda r: order.get(r.family, 9)), key=lambda r: r.family):
        cells = ([_named(r), escape(wording.quantity(r.value, r.unit))] for r in group)
        parts.append(f'<div class="group"><h3>{escape(family)}</h3>{_table((("", ""), ("", "n")), cells)}</div>')
    return "".join(parts)


def _event_table(lines: tuple[EventLine, ...]) -> str:
    head = (("Time", "n"), ("Hand", ""), ("Event", ""), ("", ""))
    rows = (
        [
            f"{e.time_s:.2f} s",
            escape(e.tool),
            escape(wording.kind_word(e.kind)),
            escape(e.text) + (f' <span class="quiet">× {e.count}</span>' if e.count > 1 else ""),
        ]
        for e in lines
    )
    return _table(head, rows, "events")


def _where(
    shown: StitchMap, angles: Histogram, tissue: tuple[TissueRow, ...], origin: str, span: str
) -> dict[str, str]:
    """The figures of what the instruments did: where the needle went, or what was done to which structure."""
    if tissue:
        last = " in the last session" if origin else ""
        return {"map_title": f"What was done to which structure{last}", "map": _tissue_table(tissue)}
    drawn = _fill(
        "needle.html",
        stitch_map=figures.stitch_map(shown),
        map_caption=escape(origin + MAP_CAPTION + _stitch_words(shown)),
        histogram=figures.angle_histogram(angles),
        histogram_caption=escape(f"{_passes(sum(angles.counts))}{span}, in bins of 5°."),
    )
    return {"map_title": "Where the needle went", "map": drawn}


def _tissue_table(rows: tuple[TissueRow, ...]) -> str:
    columns = tissue_columns(rows)
    names = [escape(r.structure) + ("" if r.asked else f' <span class="missed">{NOT_ASKED}</span>') for r in rows]
    return _table((("Structure", ""), *((name, "n") for name in columns)), zip(names, *columns.values(), strict=True))


def _stitch_words(shown: StitchMap) -> str:
    return " A line joins the two bites of a stitch: level is straight." if len(shown.vessels) > 1 else ""


def _passes(count: int) -> str:
    return f"{count} pass{'es' if count != 1 else ''} of the needle"


def _definitions(rows: tuple[MetricRow, ...]) -> str:
    said = " ".join(f"<strong>{escape(r.title)}</strong>: {escape(r.meaning)}" for r in rows)
    return f"<p>{said}</p>"


def _closing(versions: dict[str, str], overruns: int) -> str:
    by = f" Scored from the log; recorded by trainer {escape(versions['trainer'])}." if "trainer" in versions else ""
    late = f" {overruns} ticks took longer than their slot." if overruns else ""
    assumed = " A target marked “assumed” is a design choice that nobody has measured."
    return f"<p><strong>{wording.DISCLAIMER}</strong>{assumed}{by}{late}</p>"


def _task_section(task: TaskProgress, sources: Sources) -> str:
    curves = "".join(
        f"<figure><strong>{escape(c.title)}</strong> <span class='quiet'>{escape(wording.unit_word(c.unit))}</span>"
        f"{figures.learning_curve(c, len(task.attempts))}<figcaption>{escape(curve_words(c))}</figcaption></figure>"
        for c in task.curves
    )
    sessions = f"the last {task.map_sessions} sessions" if task.map_sessions > 1 else "the last session"
    return _fill(
        "task.html",
        task_title=escape(wording.within(task.title, task.anatomy)),
        summary=escape(task_summary(task)),
        curves=curves,
        rows=_progress_table(task.rows, sources),
        **_where(task.stitch_map, task.histogram, task.tissue, f"From {sessions}. ", " in all sessions"),
        attempts=_attempt_table(task.attempts, task.curves),
    )


def _progress_table(rows: tuple[ProgressRow, ...], sources: Sources) -> str:
    kinds = {"Measure": "", "Last": "n", "Best": "n", "Last and five before": "", "Target": "", "Source": "quiet"}
    head = (*kinds.items(), ("", ""))

    def cells(row: ProgressRow) -> list[str]:
        attempt = f' <span class="quiet">#{row.best_attempt}</span>' if row.best_attempt is not None else ""
        best = escape(wording.quantity(row.best, row.last.unit)) + attempt
        shown = row.last.has_target
        strip = figures.strip(row.last, row.earlier) if shown else ""
        source, verdict = (sources.cite(row.last), _verdict(row.last)) if shown else ("", "")
        return [_named(row.last), _value(row.last), best, strip, _target(row.last), source, verdict]

    return _table(head, map(cells, rows))


def _attempt_table(attempts: tuple[Attempt, ...], curves: tuple[Curve, ...]) -> str:
    head = (("#", "n"), ("Date", ""), ("Outcome", ""), *((c.title, "n") for c in curves), ("Session", ""))
    rows = (
        [
            str(a.number),
            escape(wording.date(a.started_at)),
            escape(a.outcome),
            *(escape(wording.quantity(a.values.get(c.name), c.unit)) for c in curves),
            f'<span class="quiet">{escape(a.session)}</span>',
        ]
        for a in reversed(attempts)
    )
    return _table(head, rows, "events")
