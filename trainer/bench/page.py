"""The report of ``trainer bench speed-error``: a page in Markdown, a chart, and the numbers."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from trainer.bench.chart import chart
from trainer.bench.machine import in_words
from trainer.bench.rows import Row, plain


@dataclass(frozen=True)
class Subject:
    """What a module ``trainer.bench.<name>`` measures; the report has its docstring, too."""

    title: str
    counts: str  # what a row's size counts


#: Each has ``measure(quick) -> list[Row]``.
SUBJECTS = {
    "vessel": Subject("A vessel's static equilibrium", "nodes"),
    "integrators": Subject("A swinging vessel", "nodes"),
    "thread": Subject("A thread", "links"),
    "contact": Subject("Contact search", "triangles or segments"),
    "volume": Subject("Volumes of elements", "elements"),
    "model": Subject("What the link mesh gets wrong of a solid", "nodes"),
}

Rows = Mapping[str, Sequence[Row]]


def measure(quick: bool, tell: Callable[[str], None]) -> dict[str, list[Row]]:
    """All subjects, one after the other; ``tell`` is told which one it is at."""
    found: dict[str, list[Row]] = {}
    for name in SUBJECTS:
        tell(f"{SUBJECTS[name].title}, {len(found) + 1} of {len(SUBJECTS)}")
        found[name] = import_module(f"trainer.bench.{name}").measure(quick)
    return found


def document(rows: Rows, about: dict[str, Any], quick: bool) -> dict[str, Any]:
    """What ``--json`` prints and ``speed_error.json`` holds."""
    return {
        "quick": quick,
        "machine": about,
        "rows": [{"subject": name, **plain(row)} for name, of_subject in rows.items() for row in of_subject],
    }


def write(folder: Path, rows: Rows, about: dict[str, Any], quick: bool) -> list[Path]:
    """``speed_error`` .md, .svg and .json in ``folder``, which is made if need be. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    counts = {name: SUBJECTS[name].counts for name in rows}
    written = {
        folder / "speed_error.md": markdown(rows, about, quick),
        folder / "speed_error.svg": chart(rows, counts) + "\n",
        folder / "speed_error.json": json.dumps(document(rows, about, quick), indent=1, allow_nan=False) + "\n",
    }
    for path, words in written.items():
        path.write_text(words, encoding="utf-8")
    return list(written)


def markdown(rows: Rows, about: dict[str, Any], quick: bool) -> str:
    lines = [
        "# Time against error",
        "",
        f"Written by `trainer bench speed-error{' --quick' if quick else ''}`. {in_words(about)}.",
        "",
        "![Time against error](speed_error.svg)",
        "",
        "Times are medians, with the 90th percentile; error and residual are the worst of all frames. The methods of a",
        "case take turns, frame by frame. A line of the chart is one method at one size, a point one of its settings.",
    ]
    for name, of_subject in rows.items():
        lines += ["", *_section(name, of_subject)]
    return "\n".join([*lines, ""])


def _section(name: str, rows: Sequence[Row]) -> list[str]:
    subject = SUBJECTS[name]
    about = (inspect.getdoc(import_module(f"trainer.bench.{name}")) or "").partition("\n\n")[2]
    lines = [f"## {subject.title}", "", about, ""]
    for what in dict.fromkeys(r.error_of for r in rows):
        lines.append(f"* Error of the {what}.")
    for what in dict.fromkeys(r.residual_of for r in rows):
        lines.append(f"* Residual: {what}.")
    lines += [
        "",
        "The fastest setting tried of each method whose error is small enough:",
        "",
        *comparison(rows, subject),
        "",
        f"| case | {subject.counts} | method | setting | frames | median ms | p90 ms | error | residual | status |",
        "|---|--:|---|---|--:|--:|--:|--:|--:|---|",
    ]
    for r in rows:
        numbers = f"{ms(r.median_ms)} | {ms(r.p90_ms)} | {size_of(r.error)} | {size_of(r.residual)}"
        lines.append(f"| {r.case} | {r.size} | {r.method} | {r.setting} | {r.frames} | {numbers} | {r.status} |")
    return lines


def ms(value: float) -> str:
    """A time to three digits, without an exponent; nothing where none was measured."""
    if math.isnan(value):
        return ""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def size_of(value: float) -> str:
    """An error or a residual to two digits; nothing where none was measured."""
    return "" if math.isnan(value) else f"{value:.1e}"


def comparison(rows: Sequence[Row], subject: Subject) -> list[str]:
    """For each case and size the fastest setting of each method whose error is small enough, as a list.

    What is enough the case says; rows that answer nothing, as limits of the memory, are not compared.
    """
    said = []
    timed = [(r, r.compared_at) for r in rows if r.frames and r.compared_at is not None]
    for case, size, bound in dict.fromkeys((r.case, r.size, bound) for r, bound in timed):
        here = [r for r, _ in timed if (r.case, r.size, r.compared_at) == (case, size, bound)]
        words = []
        for method in dict.fromkeys(r.method for r in here):
            tried = [r for r in here if r.method == method]
            enough = [r.median_ms for r in tried if r.error <= bound]
            if enough:
                words.append(f"{method} {ms(min(enough))} ms")
            else:
                best = min(tried, key=lambda r: r.error)
                words.append(f"{method} none (best error {size_of(best.error)} in {ms(best.median_ms)} ms)")
        said.append(f"* {case}, {size} {subject.counts}, error at most {bound:g}: {'; '.join(words)}.")
    return said
