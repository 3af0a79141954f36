"""What a report says in a sentence: rules over the numbers, never free text."""

from __future__ import annotations

from trainer.reporting import wording
from trainer.reporting.progress import Curve, TaskProgress
from trainer.reporting.session import SessionReport


def session_summary(report: SessionReport) -> str:
    """How many targets were met, and which were missed."""
    measured = sum(row.met is not None for row in report.targets)
    first = f"{report.met} of {len(report.targets)} targets met"
    first += "." if measured == len(report.targets) else f"; {len(report.targets) - measured} could not be measured."
    missed = [
        f"{r.title.lower()} {wording.quantity(r.value, r.unit)} ({wording.band(r.target_low, r.target_high, r.unit)})"
        for r in report.missed
    ]
    return f"{first} Outside: {', '.join(missed)}." if missed else first


def task_summary(task: TaskProgress) -> str:
    """Attempts and how the last one stands against the targets."""
    rows = [r.last for r in task.rows if r.last.has_target]
    met = sum(r.met is True for r in rows)
    tried = f"{len(task.attempts)} attempt{'s' if len(task.attempts) != 1 else ''}, {task.completed} completed."
    return f"{tried} The last attempt met {met} of {len(rows)} targets."


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
    return said + f" Slope {t.slope:+.1f}{gap}{unit} per attempt (95 %: {t.low:+.1f} to {t.high:+.1f})."
