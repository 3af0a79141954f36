"""The report of ``trainer bench stability``: what becomes of hard cases, for every method of mechanics.

Each module of ``SUBJECTS`` has ``cases() -> [(case, method, run)]``: ``run()`` answers "ok: …", "refused: …" or
"not converged: …", and raises AssertionError where a law is broken.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

from trainer.bench.machine import in_words

Case = tuple[str, str, Callable[[], str]]

#: Modules of trainer.bench and their titles; the report has their docstrings, too, which state the laws.
SUBJECTS = {
    "hard_integrators": "Integration in time",
    "hard_vessel": "Static equilibrium",
    "hard_cut": "Cuts",
    "hard_thread": "The thread",
    "hard_draped": "The thread on vessels",
    "hard_contact": "Contact search",
    "hard_volume": "Volumes of tissue",
    "hard_scan": "Scans",
    "hard_scene": "Whole exercises",
}
#: How a case can end; the last is the only one that must not be.
ENDINGS = ("ok", "refused", "not converged", "BROKEN")
#: What --quick leaves out, (case, method): what takes four seconds or more when all kernels are compiled.
LONG = frozenset(
    {
        ("link of no length", "relaxation"),
        ("node pulled by 3 R", "relaxation"),
        ("patch pushed in by 0.8 R in one jump", "relaxation"),
        ("patch pushed in by 1.2 R in one jump", "relaxation"),
        ("patch pushed in by 1.2 R in one jump", "Newton, SuperLU"),
        ("collapsed vessel pulled open again", "relaxation"),
        ("collapsed vessel pulled open again", "Newton, SuperLU"),
        ("held end leaps 20 mm in one tick", "XPBD, substeps of 10 µs"),
        ("1000 links fall on the vessel in a heap, soft", "rod"),
        ("1000 links fall on the vessel in a heap, limp", "rod"),
        ("1000 links wound and heaped on two vessels", "follow-the-leader, draped"),
    }
)


@dataclass(frozen=True)
class Outcome:
    """How one method ended in one case."""

    case: str
    method: str
    outcome: str  # one of ENDINGS, a colon, and a number or a reason; "left out" under --quick
    seconds: float  # compilation included, where it was the first to need a kernel

    @property
    def ending(self) -> str:
        return self.outcome.partition(":")[0]


Outcomes = Mapping[str, Sequence[Outcome]]


def measure(quick: bool, tell: Callable[[str], None]) -> dict[str, list[Outcome]]:
    """All cases of all subjects, one after the other; ``tell`` is told which one it is at."""
    found: dict[str, list[Outcome]] = {}
    for name in SUBJECTS:
        tell(f"{SUBJECTS[name]}, {len(found) + 1} of {len(SUBJECTS)}")
        found[name] = collect(import_module(f"trainer.bench.{name}").cases(), quick)
    return found


def collect(cases: Iterable[Case], quick: bool) -> list[Outcome]:
    """Run ``cases``. A case that raises is broken, whatever it raises, and the others go on."""
    found = []
    for case, method, run in cases:
        if quick and (case, method) in LONG:
            found.append(Outcome(case, method, "left out", 0.0))
            continue
        begun = perf_counter()
        try:
            outcome = run()
            if outcome.partition(":")[0] not in ENDINGS[:-1]:
                outcome = f"BROKEN: it answered {outcome!r}"
        except AssertionError as law:
            outcome = f"BROKEN: {law}"
        except Exception as error:
            outcome = f"BROKEN: {type(error).__name__}: {error}"
        found.append(Outcome(case, method, outcome, perf_counter() - begun))
    return found


def counts(outcomes: Outcomes) -> dict[str, int]:
    """How many cases ended how; those left out, too."""
    endings = [o.ending for of_subject in outcomes.values() for o in of_subject]
    return {ending: endings.count(ending) for ending in (*ENDINGS, "left out")}


def document(outcomes: Outcomes, about: dict[str, Any], quick: bool) -> dict[str, Any]:
    """What ``--json`` prints."""
    return {
        "quick": quick,
        "machine": about,
        "counts": counts(outcomes),
        "cases": [{"subject": name, **asdict(o)} for name, of_subject in outcomes.items() for o in of_subject],
    }


def write(folder: Path, outcomes: Outcomes, about: dict[str, Any], quick: bool) -> Path:
    """``stability.md`` in ``folder``, which is made if need be. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "stability.md"
    path.write_text(markdown(outcomes, about, quick), encoding="utf-8")
    return path


def markdown(outcomes: Outcomes, about: dict[str, Any], quick: bool) -> str:
    lines = [
        "# Hard cases",
        "",
        f"Written by `trainer bench stability{' --quick' if quick else ''}`. {in_words(about)}.",
        "",
        "None of these may end in a number that is not finite, in a leap, or in a silent wrong answer. A method may",
        "refuse a case in one line, or say that it did not converge (where a method cannot, its case does); *BROKEN*",
        "is a law that does not hold. Each section states its laws and where their thresholds come from. Seconds are",
        "those of one run, compilation included where a case is the first to need a kernel. `--quick` leaves out what",
        "takes four seconds or more.",
        "",
        f"{in_numbers(outcomes)}.",
    ]
    for name, of_subject in outcomes.items():
        laws = inspect.getdoc(import_module(f"trainer.bench.{name}")) or ""
        lines += ["", f"## {SUBJECTS[name]}", "", laws, ""]
        lines += ["| case | method | outcome | s |", "|---|---|---|--:|"]
        for o in of_subject:
            lines.append(f"| {o.case} | {o.method} | {_cell(o.outcome)} | {o.seconds:.2f} |")
    return "\n".join([*lines, ""])


def in_numbers(outcomes: Outcomes) -> str:
    """ "12 cases: 10 ok, 2 refused"."""
    found = counts(outcomes)
    return f"{sum(found.values())} cases: " + ", ".join(f"{n} {ending}" for ending, n in found.items() if n)


def _cell(words: str) -> str:
    """A text in one cell of a table."""
    return " ".join(words.split()).replace("|", "\\|")
