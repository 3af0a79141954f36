"""Which method moves a component of a scene, and how exactly: the cheapest one that was measured to be right enough.

A task states how far a node may be from where it would come to rest, and what force may be left over (``[solver]``);
``reports/speed_error.json`` says what each method with each setting costs and how far off it is. Which methods a
scene can run on is another question. Tissue: the kept factor alone, since no other method knows anchors, cables and
loads; so its tolerance is what is chosen, and a method that would be cheaper is named beside it. Thread: following the
leader alone, which is exact in its lengths, so there is nothing to choose.

Which of two settings is the faster is noise where they differ by less than the measurement spreads: where the median
of one is within the 90th percentile of the fastest. Of such settings the one with the largest tolerance is taken: from
the same start it never takes more iterations than one that asks for less, and a report that was made anew, on another
day, does not give a task another tolerance.

All that is the error of a solver. That of the model, which is far larger, comes from the same report and is told beside
it: of the link mesh against the theory of a solid, and of the thread against one with weight, inertia and stiffness.

A report speaks of the vessel of its own bench. Another vessel of the same proportions behaves the same in units of
its own: lengths in radii, forces in modulus times wall thickness times radius (the links' stiffness is proportional
to modulus times thickness). With other proportions this is an approximation.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from trainer import config
from trainer.config import ConfigError
from trainer.curriculum import AnatomySpec, SolverSpec, Task, ThreadSpec, VesselSpec
from trainer.data_files import data_folder

#: The rows that are like a task: an instrument leads a vessel's end that is cut free at 100 frames a second.
CASE = "tracking, cut free"
#: The rows that are like a scene's thread: 100 mm of suture, one end of which is led around a loop in a second.
THREAD_CASE, THREAD_METHOD = "drag, suture", "follow-the-leader"
#: Cases whose frames cost alike: where that one was not measured at a size, another one may have been timed there.
TRACKING = "tracking, "
#: A vessel of so many times the nodes of any that was measured is beyond the report.
BEYOND = 2.0
#: Methods that a scene's tissue can run on.
RUNNABLE = ("kept factor",)
#: The vessel of these rows (``trainer/bench/vessel.py``): outer radius and wall in mm, modulus in kPa.
BENCH_RADIUS_MM, BENCH_WALL_MM, BENCH_MODULUS_KPA = 0.5, 0.15, 500.0


#: The force in a setting as the report words it: ``to 0.01 mN``, ``to 0.001 (0.07 mN)``.
FORCE = re.compile(r"([\d.]+(?:e[+-]?\d+)?) mN")
#: The rows of what a link mesh gets wrong, and how many nodes around it has (``trainer/bench/model.py``).
MESH, AROUND = "link mesh", re.compile(r"(\d+) around")


@dataclass(frozen=True)
class Measured:
    """One method with one setting as the report has it, carried over to the vessel of a scene."""

    method: str
    setting: str
    nodes: int  # of the vessel that it was measured on
    measured_ms: float  # median of a frame
    measured_p90_ms: float  # the median where too few frames were timed to tell
    measured_solver_error_mm: float  # largest distance of a node to where it would come to rest
    tolerance_mN: float  # unbalanced force at which a solve ends


@dataclass(frozen=True)
class Choice(Measured):
    """What a scene's tissue runs on."""

    budget: SolverSpec
    source: str  # of the measurement
    cheapest: Measured  # of all methods that meet the budget; another one than chosen is cheaper, and no scene's
    model_error: dict[str, float]  # under each load that was measured, a share; empty where the report has none
    model_error_of: str  # what these are shares of, and on which mesh
    timed_nodes: int  # of the vessel nearest in size on which frames of the method were timed, in whatever tracking …
    timed_ms: float  # … and the median of these
    beyond_nodes: int = 0  # of the task's largest vessel that is beyond what was measured; 0 where none is


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
    rows = _tissue_rows(path)
    choices = [_for_vessel(vessel, task.solver, rows, name, path) for vessel in task.scene.vessel]
    chosen = min(choices, key=lambda choice: choice.tolerance_mN)
    return replace(chosen, beyond_nodes=max(choice.beyond_nodes for choice in choices))


def beyond(choice: Choice | None) -> str:
    """One line where a vessel is so large that no measurement speaks of its error, "" where none is."""
    if choice is None or choice.beyond_nodes == 0:
        return ""
    return (
        f"a vessel has {choice.beyond_nodes} nodes, more than {BEYOND:g} times as many as any that the choice was "
        f"measured on ({choice.source}): whether it keeps 'solver.node_error_mm' there is not known"
    )


def overfull(task: Task, choice: Choice | None) -> str:
    """One line where a tick of the task cannot hold its vessels, "" where it can.

    The time of a frame at the nearest size at which any was measured is carried over in proportion to the nodes of all
    vessels, which are solved together: a lower bound where they have more, since a direct solver's work grows faster,
    and a tick may be taken in several movements.
    """
    if choice is None:
        return ""
    nodes = sum(2 * v.layers * v.around for v in task.scene.vessel)
    expected_ms, tick_ms = choice.timed_ms * nodes / choice.timed_nodes, 1000.0 / task.tick_hz
    if expected_ms <= tick_ms:
        return ""
    return (
        f"the vessels have {nodes} nodes: a tick is expected to take {expected_ms:.0f} ms or more, the task gives it "
        f"{tick_ms:g} ms ({choice.timed_ms:.3g} ms were measured at {choice.timed_nodes} nodes); getting ready may "
        "take minutes, and less 'layers' or 'around' are faster"
    )


def thread_method(thread: ThreadSpec | None, report: Path | None = None) -> dict[str, Any] | None:
    """What moves a scene's thread, in words and numbers; None where no thread is.

    Of ``report`` as in :func:`choose_tissue`, the row with the nearest number of links. Raises ConfigError likewise.
    """
    if thread is None:
        return None
    links = round(thread.length_mm / thread.link_mm)
    path = report or report_path()
    rows = _rows(path, lambda row: (row["case"], row["method"]) == (THREAD_CASE, THREAD_METHOD))
    nearest = min(rows, key=lambda row: max(row["size"] / links, links / row["size"]), default=None)
    return {
        "method": "follow the leader",
        "links": links,
        "link_mm": thread.link_mm,
        "source": "Brown et al. 2001, section 4; keeps lengths exactly, so it has no setting",
        "model": "geometric and quasi-static: no weight, no inertia, no bending stiffness",
        "measured_ms": None if nearest is None else nearest["median_ms"],
        "model_error": None if nearest is None else nearest["error"],
        "model_error_of": "model: not measured"
        if nearest is None
        else "model: largest distance of a node from a dynamic thread of 100 mm that is led the same way, over its "
        f"length; {path.name}, '{THREAD_CASE}', {nearest['size']} links",
    }


def region_method(anatomy: AnatomySpec | None) -> dict[str, Any] | None:
    """What moves the tissue of a region, in words; None where no region is."""
    if anatomy is None:
        return None
    return {
        "method": "ChainMail and elastic relaxation",
        "source": "Gibson et al. 1998, section 3.2; limits and time constant are the task's",
    }


def _rows(path: Path, wanted: Callable[[dict[str, Any]], bool]) -> list[dict[str, Any]]:
    """The rows of a report that are ``wanted``. Raises ConfigError."""
    if not path.exists():
        raise ConfigError(f"{path}: no such report; {_again(path)} writes one")
    try:
        rows = json.loads(config.read_text(path))["rows"]
        if all(map(_is_row, rows)):
            return [row for row in rows if wanted(row)]
    except (json.JSONDecodeError, KeyError, TypeError, RecursionError):
        pass
    raise ConfigError(f"{path}: not a report; {_again(path)} writes one")


def _is_row(row: dict[str, Any]) -> bool:
    """Whether a row has what a choice reads, as the bench writes it. Raises KeyError and TypeError where it has not."""
    words = all(isinstance(row[key], str) for key in ("case", "method", "setting", "status", "error_of"))
    measured = (row[key] for key in ("median_ms", "p90_ms", "error"))
    return words and type(row["size"]) is int and row["size"] > 0 and all(map(_is_measured, measured))


def _is_measured(value: Any) -> bool:
    """A number that can have been measured, or none."""
    return value is None or (type(value) in (int, float) and 0.0 <= value < math.inf)


def _again(path: Path) -> str:
    """What writes the report where it is looked for."""
    return f"`trainer bench speed-error --out {path.parent}`"


def _tissue_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of tracking that converged to a force, with errors in radii of the vessel. Raises ConfigError."""

    def like_a_task(row: dict[str, Any]) -> bool:
        tracked = row["case"].startswith(TRACKING) and row["status"] == "converged" and "radii" in row["error_of"]
        timed = tracked and row["error"] is not None and 0.0 < (row["median_ms"] or 0.0) <= (row["p90_ms"] or math.inf)
        return timed and FORCE.search(row["setting"]) is not None

    rows = _rows(path, like_a_task)
    if not any(row["case"] == CASE and row["method"] in RUNNABLE for row in rows):
        raise ConfigError(f"{path}: no {' or '.join(RUNNABLE)} converged in '{CASE}'; {_again(path)} measures it")
    return rows


def _for_vessel(vessel: VesselSpec, budget: SolverSpec, rows: list[dict[str, Any]], name: str, path: Path) -> Choice:
    nodes = 2 * vessel.layers * vessel.around
    # What can be chosen must have been measured at this size; the report may hold others without it.
    sizes = {row["size"] for row in rows if row["case"] == CASE and row["method"] in RUNNABLE}
    nearest = _nearest(sizes, nodes)
    source = f"{path.name}, '{CASE}', {nearest} nodes"
    here = [_measured(row, vessel) for row in rows if row["case"] == CASE and row["size"] == nearest]
    enough = [
        m
        for m in here
        if m.measured_solver_error_mm <= budget.node_error_mm and m.tolerance_mN <= budget.force_error_mN
    ]
    able = [m for m in enough if m.method in RUNNABLE]
    if not able:
        best = min((m for m in here if m.method in RUNNABLE), key=lambda m: m.measured_solver_error_mm)
        raise ConfigError(
            f"{name}: nothing that a scene can run on was measured to keep 'solver.node_error_mm' = "
            f"{budget.node_error_mm:g} with 'solver.force_error_mN' = {budget.force_error_mN:g}; the best is "
            f"{best.measured_solver_error_mm:.2g} mm with {best.tolerance_mN:.2g} mN ({best.method}: {source})"
        )
    chosen = _cheapest(able)
    fastest = min(enough, key=lambda m: m.measured_ms)
    cheapest = chosen if chosen.measured_ms <= fastest.measured_p90_ms else fastest
    errors, of = _model_error(vessel, path)
    timed = [(row["size"], row["median_ms"]) for row in rows if row["method"] == chosen.method]
    timed_nodes = _nearest({nearest, *(size for size, _ in timed)}, nodes)
    return Choice(
        **vars(chosen),
        budget=budget,
        source=source,
        cheapest=cheapest,
        model_error=errors,
        model_error_of=of,
        timed_nodes=timed_nodes,
        timed_ms=chosen.measured_ms if timed_nodes == nearest else min(ms for size, ms in timed if size == timed_nodes),
        beyond_nodes=nodes if nodes > BEYOND * nearest else 0,
    )


def _nearest(sizes: set[int], nodes: int) -> int:
    """The size of the nearest ratio to ``nodes``."""
    return min(sizes, key=lambda size: max(size / nodes, nodes / size))


def _cheapest(measured: list[Measured]) -> Measured:
    """The fastest; of those that are within its spread, the one with the largest tolerance."""
    fastest = min(measured, key=lambda m: m.measured_ms)
    alike = [m for m in measured if m.measured_ms <= fastest.measured_p90_ms]
    return max(alike, key=lambda m: (m.tolerance_mN, -m.measured_ms))


def _model_error(vessel: VesselSpec, path: Path) -> tuple[dict[str, float], str]:
    """Of a link mesh with as many nodes around as the vessel, or nearly, by load; and what it is of."""

    def around(row: dict[str, Any]) -> int:
        found = AROUND.fullmatch(row["setting"])
        return 0 if found is None else int(found[1])

    rows = _rows(path, lambda row: row["method"] == MESH and around(row) > 0)
    if not rows:
        return {}, "model: not measured"
    nearest = min((around(row) for row in rows), key=lambda n: max(n / vessel.around, vessel.around / n))
    here = [row for row in rows if around(row) == nearest]
    return {row["case"]: row["error"] for row in here}, f"{here[0]['error_of']}; {path.name}, {nearest} nodes around"


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
        measured_p90_ms=row["median_ms"] if row["p90_ms"] is None else row["p90_ms"],
        measured_solver_error_mm=row["error"] * radius,
        tolerance_mN=float(found[1]) * unit_mN / (BENCH_MODULUS_KPA * BENCH_WALL_MM * BENCH_RADIUS_MM),
    )
