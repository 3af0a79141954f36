"""How a stitch joins two ends of a vessel: equal bites, opposite each other, edges together."""

from __future__ import annotations

import math

import numpy as np

from trainer.curriculum import VesselSpec
from trainer.geometry import Array, cross, unit
from trainer.metrics.performance import Performance, wrap_deg
from trainer.metrics.registry import joins, metric


def rest_point(vessel: VesselSpec, axial_mm: float, clock_deg: float) -> Array:
    """Place (3,) mm on the outer surface of a vessel at rest, in the frame of the scene.

    12 o'clock is the scene's +z made perpendicular to the axis (+y for an axis along z). 3 o'clock belongs to
    the line of the axis, not to its direction: its y is positive, or its x where y is 0, so that the clock
    runs in one sense on two facing ends.
    """
    axis = unit(vessel.axis)
    up = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 1.0 - 1e-9 else np.array([0.0, 1.0, 0.0])
    twelve = unit(_across(up, axis))
    three = cross(axis, twelve)
    three = three if (three[1] if abs(three[1]) > 1e-9 else three[0]) > 0.0 else -three
    psi = math.radians(clock_deg)
    radial = math.cos(psi) * twelve + math.sin(psi) * three
    return np.asarray(np.asarray(vessel.cut_edge_mm) + axial_mm * axis + 0.5 * vessel.outer_diameter_mm * radial)


def _across(v: Array, axis: Array) -> Array:
    return v - float(v @ axis) * axis


@metric("bite_asymmetry", "ratio", joins, better="lower")
def bite_asymmetry(performance: Performance, _: str) -> float | None:
    """Difference of the stitch's two bites over their mean; 0 is equal bites."""
    stitch = performance.stitch
    if stitch is None:
        return None
    a, b = stitch.entry.axial_mm, stitch.exit.axial_mm
    return 2.0 * abs(a - b) / (a + b) if a + b > 0.0 else None


@metric("side_mismatch_mm", "mm", joins, better="lower")
def side_mismatch(performance: Performance, _: str) -> float | None:
    """Distance around the vessel between the stitch's two bites: R · |clock difference|.

    R is the mean outer radius of the two ends. A mismatch turns the ends against each other.
    """
    stitch = performance.stitch
    if stitch is None:
        return None
    radius = 0.25 * sum(performance.vessels[p.body].outer_diameter_mm for p in (stitch.entry, stitch.exit))
    return radius * math.radians(abs(wrap_deg(stitch.entry.clock_deg - stitch.exit.clock_deg)))


@metric("obliquity_deg", "deg", joins, better="lower", version="2")
def obliquity(performance: Performance, _: str) -> float | None:
    """Angle of the stitch to the vessel's axis; 0 is across the cut at right angles.

    Between the two outer holes, both carried back to the vessels at rest, so that it judges where the
    needle went through the tissue and not how the ends were held meanwhile; and with the centres of the two
    cuts laid on each other, as the stitch draws them together, so that it does not depend on where the task
    parks the ends. With bites of 0.35 mm a hole 0.2 mm aside is atan(0.2 / 0.7) = 15.9 degrees. The axis is
    the first end's.
    """
    stitch = performance.stitch
    if stitch is None:
        return None
    first, second = performance.vessels[stitch.entry.body], performance.vessels[stitch.exit.body]
    start = rest_point(first, stitch.entry.axial_mm, stitch.entry.clock_deg)
    end = rest_point(second, stitch.exit.axial_mm, stitch.exit.clock_deg)
    bite = end - start - (np.asarray(second.cut_edge_mm) - np.asarray(first.cut_edge_mm))
    axis = unit(first.axis)
    along = abs(float(bite @ axis))
    across = float(np.linalg.norm(_across(bite, axis)))
    return math.degrees(math.atan2(across, along)) if along + across > 0.0 else None


@metric("stitch_count", "count", joins)
def stitch_count(performance: Performance, _: str) -> float:
    """Stitches in place at the end: from outside into one end and out of the other, with needle or thread in them."""
    return float(len(performance.stitches))


@metric("tail_mm", "mm", joins)
def tail(performance: Performance, _: str) -> float | None:
    """Thread left before the first hole when the exercise ended."""
    end = performance.end
    return end.tail_mm if end is not None and performance.stitch is not None else None


@metric("gap_mm", "mm", joins, better="lower")
def gap(performance: Performance, _: str) -> float | None:
    """Distance of the two ends' edges at the stitch when the exercise ended."""
    end = performance.end
    return end.gap_mm if end is not None and performance.stitch is not None else None
