"""What a measurement of time against error says of one method on one case."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One method with one setting on one case. Error and residual are the worst of all frames."""

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
