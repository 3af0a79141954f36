"""Which method moves a component of a scene, and how exactly: the cheapest one that was measured to be right enough.

A task states how far a node may be from where it would come to rest, and what force may be left over (``[solver]``);
``reports/speed_error.json`` says what each method with each setting costs and how far off it is. Which methods a
scene can run on is another question. Tissue: the kept factor alone, since no other method knows anchors, cables and
loads; so its tolerance is what is chosen, and a method that would be cheaper is named beside it. Thread: following the
leader alone, which is exact in its lengths, so there is nothing to choose.

A report speaks of the vessel of its own bench. Another vessel of the same proportions behaves the same in units of
its own: lengths in radii, forces in modulus times wall thickness times radius (the links' stiffness is proportional
to modulus times thickness). With other proportions this is an approximation.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainer import config
from trainer.config import ConfigError
from trainer.curriculum import AnatomySpec, SolverSpec, Task, ThreadSpec, VesselSpec
from trainer.data_files import data_folder

#: The rows that are like a task: an instrument leads a vessel's end that is cut free at 100 frames a second.
CASE = "tracking, cut free"
#: Methods that a scene's tissue can run on.
RUNNABLE = ("kept factor",)
#: The vessel of these rows (``trainer/bench/vessel.py``): outer radius and wall in mm, modulus in kPa.
BENCH_RADIUS_MM, BENCH_WALL_MM, BENCH_MODULUS_KPA = 0.5, 0.15, 500.0


#: The force in a setting as the report words it: ``to 0.01 mN``, ``to 0.001 (0.07 mN)``.
FORCE = re.compile(r"([\d.]+(?:e[+-]?\d+)?) mN")


@dataclass(frozen=True)
class Measured:
    """One method with one setting as the report has it, carried over to the vessel of a scene."""

    method: str
    setting: str
    nodes: int  # of the vessel that it was measured on
    measured_ms: float  # median of a frame
    measured_error_mm: float  # largest distance of a node to where it would come to rest
    tolerance_mN: float  # unbalanced force at which a solve ends


@dataclass(frozen=True)
class Choice(Measured):
    """What a scene's tissue runs on."""

    budget: SolverSpec
    source: str  # of the measurement
    cheapest: Measured  # of all methods that meet the budget; another one than chosen is one that no scene runs on


def report_path() -> Path:
    """The measurements that came with the program, or were made in this checkout."""
    return data_folder("reports") / "speed_error.json"


def choose_tissue(task: Task, name: str, report: Path | None = None) -> Choice | None:
    """The cheapest setting that meets the budget of the task in the file ``name``; None where no vessel is.

    Of several vessels the one that asks for the smallest tolerance decides. ``report`` is that of ``trainer bench
    speed-error``, by default the packaged one. Raises ConfigError for a budget that nothing meets, and for a file
    that is no such report.
    """
    if not task.scene.vessel:
        return None
    path = report or report_path()
    rows = _rows(path)
    choices = [_for_vessel(vessel, task.solver, rows, name, path) for vessel in task.scene.vessel]
    return min(choices, key=lambda choice: choice.tolerance_mN)


def overfull(task: Task, choice: Choice | None) -> str:
    """One line where a tick of the task cannot hold its vessels, "" where it can.

    The measured time of a frame is carried over in proportion to the nodes of all vessels, which are solved together: a
    lower bound, since a direct solver's work grows faster, and a tick may be taken in several movements.
    """
    if choice is None:
        return ""
    nodes = sum(2 * v.layers * v.around for v in task.scene.vessel)
    expected_ms, tick_ms = choice.measured_ms * nodes / choice.nodes, 1000.0 / task.tick_hz
    if expected_ms <= tick_ms:
        return ""
    return (
        f"the vessels have {nodes} nodes: a tick is expected to take {expected_ms:.0f} ms or more, the task gives it "
        f"{tick_ms:g} ms ({choice.source}); getting ready may take minutes, and less 'layers' or 'around' are faster"
    )


def thread_method(thread: ThreadSpec | None) -> dict[str, Any] | None:
    """What moves a scene's thread, in words and numbers; None where no thread is."""
    if thread is None:
        return None
    return {
        "method": "follow the leader",
        "links": round(thread.length_mm / thread.link_mm),
        "link_mm": thread.link_mm,
        "source": "Brown et al. 2001, section 4; keeps lengths exactly, so it has no setting",
    }


def region_method(anatomy: AnatomySpec | None) -> dict[str, Any] | None:
    """What moves the tissue of a region, in words; None where no region is."""
    if anatomy is None:
        return None
    return {
        "method": "ChainMail and elastic relaxation",
        "source": "Gibson et al. 1998, section 3.2; limits and time constant are the task's",
    }


def _rows(path: Path) -> list[dict[str, Any]]:
    """The rows of the case that converged to a force, with errors in radii of the vessel. Raises ConfigError."""
    try:
        rows = [
            row
            for row in json.loads(config.read_text(path))["rows"]
            if row["case"] == CASE and row["status"] == "converged" and "radii" in row["error_of"]
            if FORCE.search(row["setting"])
        ]
    except (json.JSONDecodeError, KeyError, TypeError):
        raise ConfigError(f"{path}: not a report; `trainer bench speed-error` writes one") from None
    if not any(row["method"] in RUNNABLE for row in rows):
        raise ConfigError(
            f"{path}: no {' or '.join(RUNNABLE)} converged in '{CASE}'; `trainer bench speed-error` measures it"
        )
    return rows


def _for_vessel(vessel: VesselSpec, budget: SolverSpec, rows: list[dict[str, Any]], name: str, path: Path) -> Choice:
    nodes = 2 * vessel.layers * vessel.around
    # What can be chosen must have been measured at this size; the report may hold others without it.
    sizes = {row["size"] for row in rows if row["method"] in RUNNABLE}
    nearest = min(sizes, key=lambda size: max(size / nodes, nodes / size))
    source = f"{path.name}, '{CASE}', {nearest} nodes"
    here = [_measured(row, vessel) for row in rows if row["size"] == nearest]
    enough = [
        m for m in here if m.measured_error_mm <= budget.node_error_mm and m.tolerance_mN <= budget.force_error_mN
    ]
    able = [m for m in enough if m.method in RUNNABLE]
    if not able:
        best = min((m for m in here if m.method in RUNNABLE), key=lambda m: m.measured_error_mm)
        raise ConfigError(
            f"{name}: nothing that a scene can run on was measured to keep 'solver.node_error_mm' = "
            f"{budget.node_error_mm:g} with 'solver.force_error_mN' = {budget.force_error_mN:g}; the best is "
            f"{best.measured_error_mm:.2g} mm with {best.tolerance_mN:.2g} mN ({best.method}: {source})"
        )
    chosen, cheapest = (min(group, key=lambda m: m.measured_ms) for group in (able, enough))
    return Choice(**vars(chosen), budget=budget, source=source, cheapest=cheapest)


def _measured(row: dict[str, Any], vessel: VesselSpec) -> Measured:
    radius = 0.5 * vessel.outer_diameter_mm
    unit_mN = vessel.modulus_kPa.value * vessel.wall_mm * radius
    found = FORCE.search(row["setting"])
    assert found is not None
    return Measured(
        method=row["method"],
        setting=row["setting"],
        nodes=row["size"],
        measured_ms=row["median_ms"],
        measured_error_mm=row["error"] * radius,
        tolerance_mN=float(found[1]) * unit_mN / (BENCH_MODULUS_KPA * BENCH_WALL_MM * BENCH_RADIUS_MM),
    )
