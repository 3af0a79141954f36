"""How the needle went through the walls: angle, place, depth, and holes that should not be there.

All geometry is taken at the instant of crossing, which the log holds interpolated inside the tick.
"""

from __future__ import annotations

import math
from statistics import fmean, median

from trainer.events import Pierce, Vector
from trainer.metrics.performance import Performance, wrap_deg
from trainer.metrics.registry import joins, metric, pierces


def angle_to_plane_deg(tangent: Vector, normal: Vector) -> float | None:
    """Angle of a direction to the plane with this normal, 0..90 degrees; None for a vector without direction.

    asin(|t·n| / |t||n|) written with atan2 of cosine and sine, which keeps its digits near 90 degrees, where
    asin loses half of them.
    """
    t_n = abs(math.fsum(a * b for a, b in zip(tangent, normal, strict=True)))
    (tx, ty, tz), (nx, ny, nz) = tangent, normal
    across = math.hypot(ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx)
    if t_n == 0.0 and across == 0.0:
        return None
    return math.degrees(math.atan2(t_n, across))


def crossing_angle_deg(p: Pierce) -> float | None:
    return angle_to_plane_deg(p.tangent, p.normal)


def _entry_angles(performance: Performance) -> list[float]:
    return [a for p in performance.entries if (a := crossing_angle_deg(p)) is not None]


@metric("entry_angle_deg", "deg", pierces, better="higher")
def entry_angle(performance: Performance, _: str) -> float | None:
    """Angle of the needle to the wall as it enters, median over the entries; 90 is upright.

    An entry is the first crossing of a pass that comes from outside: the outer wall, towards the lumen. The
    angle is asin|t·n|, recomputed from the logged vectors. t is the tangent of the needle at its *tip*, at the
    interpolated instant of puncture: the chord of a 3/8 needle held at two thirds would be wrong by up to 45
    degrees, and the next frame's tangent by what the tip turns in a tick. n is the normal of the *undented* wall:
    the rest tangent plane carried by the best rigid motion of the ring of wall between four and eight wall
    thicknesses around the point. The dent that the tip presses before it breaks through lies inside that ring, so
    it does not bend the measure, while a vessel that the other hand has turned takes the plane along.
    """
    angles = _entry_angles(performance)
    return median(angles) if angles else None


@metric("entry_angle_error_deg", "deg", pierces, better="lower")
def entry_angle_error(performance: Performance, _: str) -> float | None:
    """How far the entries are from upright: mean of |90 - entry angle|."""
    angles = _entry_angles(performance)
    return fmean(90.0 - a for a in angles) if angles else None


@metric("exit_angle_deg", "deg", joins, better="higher")
def exit_angle(performance: Performance, _: str) -> float | None:
    """Angle of the needle to the outer wall of the second end as it comes out there, median.

    Taken where a ``drive`` step asks for ``out``; same vectors as the entry angle.
    """
    second = {s.vessel for s in performance.task.step if s.kind == "drive" and s.direction == "out"}
    crossings = (p for p in performance.outer_crossings if p.direction == "out" and p.body in second)
    angles = [a for p in crossings if (a := crossing_angle_deg(p)) is not None]
    return median(angles) if angles else None


@metric("bite_{vessel}_mm", "mm", pierces)
def bite(performance: Performance, vessel: str) -> float | None:
    """Distance of the outer hole from the cut edge, in the wall's own coordinates.

    That of the last stitch; without a stitch the median over the passes.
    """
    bites = performance.bites(vessel)
    return median(p.axial_mm for p in bites) if bites else None


@metric("bite_ratio", "ratio", pierces)
def bite_ratio(performance: Performance, _: str) -> float | None:
    """Bite in wall thicknesses, median over the bites of all vessels."""
    ratios = [p.axial_mm / v.wall_mm for name, v in performance.vessels.items() for p in performance.bites(name)]
    return median(ratios) if ratios else None


@metric("clock_{vessel}_deg", "deg", pierces, version="2")
def clock(performance: Performance, vessel: str) -> float | None:
    """Clock angle of the last bite, 0..360; none where the task marks several angles on the vessel.

    Places of different bites have no meaningful average, and the last of several says nothing about the
    others: there the placement error judges each hole against its own mark.
    """
    asked = {s.clock_deg % 360.0 for s in performance.task.step if s.kind == "drive" and s.vessel == vessel}
    bites = performance.bites(vessel)
    return bites[-1].clock_deg % 360.0 if bites and len(asked) <= 1 else None


@metric("placement_error_mm", "mm", pierces, better="lower")
def placement_error(performance: Performance, _: str) -> float | None:
    """Distance on the wall between the pierced place and the step's mark, mean over the steps done.

    hypot(axial difference, R · clock difference in rad) on the outer surface at rest; a step's hole is the
    last outer crossing of its vessel in its direction before the step was done.
    """
    errors = []
    for step, p in performance.driven():
        radius = 0.5 * performance.vessels[step.vessel].outer_diameter_mm
        along = radius * math.radians(wrap_deg(p.clock_deg - step.clock_deg))
        errors.append(math.hypot(p.axial_mm - step.bite_mm, along))
    return fmean(errors) if errors else None


@metric("depth_fraction", "ratio", pierces, better="higher")
def depth_fraction(performance: Performance, _: str) -> float | None:
    """Share of the wall's thickness that the shallowest pass reached; 1 is all of it.

    The least over passes and vessels of reached depth / wall, at most 1; a pass that crossed both walls is
    1; a pass that is still under way when the session ends is left out, and so is one that ended as its
    hole tore out, whose depth is unknown.
    """
    depths = [d for w in performance.wall_passes if (d := w.depth_fraction) is not None]
    return min(depths, default=None)


@metric("partial_thickness_count", "count", pierces, better="lower", version="2")
def partial_thickness(performance: Performance, _: str) -> float | None:
    """Passes that ended without having gone through both walls of a vessel that they entered.

    A pass ends when the needle is drawn out, is pulled through, or tears out of its hole: a hole that tore
    before the other wall was crossed is of partial thickness too, though its depth is unknown. None where
    no wall was pierced.
    """
    if not performance.crossings:
        return None
    return float(sum(not w.full_thickness and w.over for w in performance.wall_passes))


@metric("back_wall_catches", "count", pierces, better="lower", version="2")
def back_wall_catches(performance: Performance, _: str) -> float | None:
    """Passes that crossed one vessel's wall at places more than 90 degrees of the clock apart.

    None where no wall was pierced: who did nothing caught no back wall, but did not avoid it either.
    """
    if not performance.crossings:
        return None
    return float(
        sum(
            any(abs(wrap_deg(p.clock_deg - q.clock_deg)) > 90.0 for p in w.crossings for q in w.crossings)
            for w in performance.wall_passes
        )
    )


@metric("extra_holes", "count", pierces, better="lower", version="2")
def extra_holes(performance: Performance, _: str) -> float | None:
    """Holes in the outer walls beyond those that the task's steps ask for.

    Each ``drive`` step asks for one hole in its vessel. If a later step has the needle withdrawn, the hole
    may be left empty; otherwise thread must stay in it, and a hole that was left again is extra (a
    correction by a new hole leaves a leak). So, per vessel: holes left beyond those that may be left, plus
    holes still filled beyond those that may be filled; a hole that is asked to be left and still holds the
    needle when the session ends is not extra. A hole that tore out counts as left: it is extra where thread
    should stay in it, and where holes may be left it takes the place of one of them. None where no wall was
    pierced.
    """
    if not performance.crossings:
        return None
    steps = performance.task.step
    last_withdraw = max((i for i, s in enumerate(steps) if s.kind == "withdraw"), default=-1)
    extra = 0
    for vessel in performance.vessels:
        asked = [i for i, s in enumerate(steps) if s.kind == "drive" and s.vessel == vessel]
        may_leave = sum(i < last_withdraw for i in asked)
        holes = {p.hole: performance.is_kept(p) for p in performance.outer_crossings if p.body == vessel}
        kept = sum(holes.values())
        left = len(holes) - kept
        extra += max(0, left - may_leave)
        extra += max(0, kept - (len(asked) - may_leave) - max(0, may_leave - left))
    return float(extra)
