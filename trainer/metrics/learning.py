"""How a value changes from attempt to attempt, said only as far as few attempts can tell.

With 15 % noise an exponential learning curve's asymptote cannot be told from 6 or 10 attempts (its
interquartile range reaches from 0 to beyond the first value), so none is fitted; a median and a robust
slope hold for a handful of attempts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from scipy import stats

#: Fewer points than this have no slope worth a line.
LEAST_FOR_SLOPE = 3


@dataclass(frozen=True)
class Trend:
    """A straight line through a value over attempts."""

    slope: float  # per attempt
    low: float  # 95 % confidence interval of the slope
    high: float
    intercept: float  # at attempt 0


def recent(values: Sequence[float], last: int = 3) -> float | None:
    """Median of the last values; None of none."""
    return median(values[-last:]) if values else None


def trend(attempts: Sequence[float], values: Sequence[float]) -> Trend | None:
    """Theil and Sen's line: the median of the slopes between all pairs (Sen 1968); None for under three points.

    One outlier in four points does not turn it. The interval is Sen's, from Kendall's tau.
    """
    if len(values) < LEAST_FOR_SLOPE:
        return None
    line = stats.theilslopes(values, attempts, alpha=0.95)
    return Trend(float(line.slope), float(line.low_slope), float(line.high_slope), float(line.intercept))
