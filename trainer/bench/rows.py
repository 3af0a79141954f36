"""What a measurement of time against error says of one method on one case."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

#: Frames of which a 90th percentile is told.
FEWEST = 5


@dataclass(frozen=True)
class Row:
    """One method with one setting on one case. Error and residual are the worst of all frames.

    A number that was not measured is NaN, and one that left all bounds is infinite: JSON has null for both.
    """

    case: str  # what is done, in words: tracking or cold, which ends are clamped, swing, drag …
    size: int  # nodes, links or triangles, as the case counts them
    method: str
    setting: str  # what was chosen to trade time for error: a tolerance, a step, a number of sweeps
    frames: int  # how often it was timed
    median_ms: float  # a frame
    p90_ms: float
    error: float
    error_of: str  # what the error is: of the solver or of the model, against which reference, in which unit
    residual: float  # what the method leaves unsolved; its unit is said in ``residual_of``
    status: str  # converged, or how it ended
    residual_of: str = "mN, Euclidean norm of the forces on the free nodes"
    compared_at: float | None = None  # the error at which the methods of the case are compared; None: no answer is


def left_out(
    case: str, size: int, method: str, reason: str, error_of: str, residual_of: str, setting: str = "none"
) -> Row:
    """The row of a method that was not measured, and why."""
    nan = math.nan
    return Row(case, size, method, setting, 0, nan, nan, nan, error_of, nan, reason, residual_of)


def median_and_p90(ms: Sequence[float]) -> tuple[float, float]:
    """Of the times of all frames. A 90th percentile of less than FEWEST frames is NaN: it would be the slowest one."""
    return float(np.median(ms)), float(np.percentile(ms, 90)) if len(ms) >= FEWEST else math.nan


def worst(known: float, found: float) -> float:
    """The larger of both; one that is not finite is infinite, and stays so."""
    return max(known, found) if math.isfinite(found) else math.inf


def plain(row: Row) -> dict[str, Any]:
    """A row as JSON has it."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(row).items()}
