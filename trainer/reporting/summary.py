"""What a report says in a sentence: rules over the numbers, never free text."""

from __future__ import annotations

from collections.abc import Sequence

from trainer.reporting import wording
from trainer.reporting.progress import Curve, TaskProgress
from trainer.reporting.session import MetricRow, SessionReport, TissueRow

#: What is said of a structure that was touched but is in no step of the task.
NOT_ASKED = "not part of the task"


def session_summary(report: SessionReport) -> str:
    """How many targets were met, which were missed, and what the device did not see."""
    first = f"{_met(report.targets)}."
    missed = [
        f"{r.title.lower()} {wording.quantity(r.value, r.unit)} ({wording.band(r.target_low, r.target_high, r.unit)})"
        for r in report.missed
    ]
    said = [first] + ([f"Outside: {', '.join(missed)}."] if missed else [])
    if report.out_of_sight:
        said.append(f"Out of sight: {report.out_of_sight}; what moved meanwhile is in the scores.")
    return " ".join(said)


def _met(targets: Sequence[MetricRow]) -> str:
    """How many targets were met, and how many had nothing to judge."""
    unmeasured = sum(row.met is None for row in targets)
    said = f"{sum(row.met is True for row in targets)} of {len(targets)} targets met"
    return said + (f", {unmeasured} not measured" if unmeasured else "")


def task_summary(task: TaskProgress) -> str:
    """Attempts and how the last one stands against the targets."""
    rows = [r.last for r in task.rows if r.last.has_target]
    tried = f"{len(task.attempts)} attempt{'s' if len(task.attempts) != 1 else ''}, {task.completed} completed."
    return f"{tried} The last attempt: {_met(rows)}."


def tissue_columns(rows: Sequence[TissueRow]) -> dict[str, list[str]]:
    """What was done to each structure, as columns under their headings, without what was done to none."""
    counts = {"grasps": [r.grasps for r in rows], "tip contacts": [r.contacts for r in rows]}
    volumes = {
        "tacked": [r.tacked_mm3 for r in rows],
        "cut": [r.cut_mm3 for r in rows],
        "torn": [r.torn_mm3 for r in rows],
    }
    found = {name: [str(n) for n in column] for name, column in counts.items() if any(column)}
    return found | {
        name: [wording.quantity(v, "mm3") for v in column] for name, column in volumes.items() if any(column)
    }


def curve_words(curve: Curve) -> str:
    """What the attempts so far can tell."""
    if curve.recent is None:
        return "No completed attempt."
    few = len(curve.values)
    over = "One completed attempt" if few == 1 else f"Median of the last {min(3, few)} completed"
    said = f"{over}: {wording.quantity(curve.recent, curve.unit)}."
    if curve.trend is None:
        return said + " Three completed attempts are needed for a slope."
    unit = wording.unit_word(curve.unit)
    gap = "" if unit == "°" else " "
    t = curve.trend
    return said + f" Slope {t.slope:+.1f}{gap}{unit} per attempt (95\u00a0%: {t.low:+.1f} to {t.high:+.1f})."
