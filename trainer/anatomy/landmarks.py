"""Where the body's axes are, as the bones themselves tell, against what the file says.

A femur lies above its tibia, a patella in front of its femur, a fibula beside its tibia on the outer side of the leg,
and each cartilage is smaller than its bone. The first two show a file that lies about up or front, the last a label
map that is not this file's. The fibula tells left from right. A mirrored right knee *is* a left knee, so exchanged
sides show only where something else says which knee it is: the label map's ``side``, or the menisci and the tibia's
cartilages, whose lateral ones must lie towards the fibula.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from trainer.config import ConfigError
from trainer.geometry import Array

Side = Literal["left", "right"]

#: Pairs that tell the outer side of the leg: the first lies lateral of the second. The fibula is the surest.
LATERAL_OF = (
    ("fibula", "tibia"),
    ("lateral meniscus", "medial meniscus"),
    ("lateral tibial cartilage", "medial tibial cartilage"),
)
ABOVE = (("femur", "tibia"), ("femoral cartilage", "tibia"), ("patella", "tibia"))
IN_FRONT_OF = (("patella", "femur"), ("patellar cartilage", "femur"), ("patella", "femoral cartilage"))
LARGER_THAN = (
    ("femur", "femoral cartilage"),
    ("femur", "patella"),
    ("tibia", "medial tibial cartilage"),
    ("tibia", "lateral tibial cartilage"),
    ("tibia", "fibula"),
    ("patella", "patellar cartilage"),
)

#: Two centres that are nearer along an axis tell nothing; assumed, a third of what any of the pairs above is apart.
LEAST_MM = 3.0


@dataclass(frozen=True)
class Body:
    """A structure from afar."""

    centre: Array  # (3,) mm, LPS
    volume_ml: float


def side(bodies: Mapping[str, Body]) -> Side | None:
    """Which knee it is, by the first of LATERAL_OF that is there; None where none is."""
    return next((told for pair in LATERAL_OF if (told := _side_of(bodies, *pair))), None)


def check(bodies: Mapping[str, Body], stated: str, name: str) -> None:
    """Raises ConfigError where structures lie as in no knee, or not as in the ``stated`` one (left, right or "")."""
    for upper, lower in ABOVE:
        if _further(bodies, lower, upper, 2) > LEAST_MM:
            raise ConfigError(
                f"{name}: the {upper} lies below the {lower}: up and down are exchanged in the file, "
                "or the label map is not this file's"
            )
    for front, back in IN_FRONT_OF:
        if _further(bodies, front, back, 1) > LEAST_MM:
            raise ConfigError(
                f"{name}: the {front} lies behind the {back}: front and back are exchanged in the file "
                "(LPS for RAS?), or the label map is not this file's"
            )
    for larger, smaller in LARGER_THAN:
        if larger in bodies and smaller in bodies and bodies[larger].volume_ml < bodies[smaller].volume_ml:
            raise ConfigError(f"{name}: the {larger} is smaller than the {smaller}: the label map is not this file's")
    sides = {pair: told for pair in LATERAL_OF if (told := _side_of(bodies, *pair))}
    for (lateral, medial), told in sides.items():
        first = next(iter(sides))
        if told != sides[first]:
            raise ConfigError(
                f"{name}: the {lateral} lies medial of the {medial}, judged by {first[0]} and {first[1]}: "
                "medial and lateral are exchanged in the label map"
            )
    told_side = side(bodies)
    if stated and told_side and stated != told_side:
        raise ConfigError(
            f"{name}: the label map says a {stated} knee, the bones are a {told_side} one's: left and right are "
            "exchanged in the file, or it is the other knee"
        )


def _side_of(bodies: Mapping[str, Body], lateral: str, medial: str) -> Side | None:
    towards_left = _further(bodies, lateral, medial, 0)
    if abs(towards_left) < LEAST_MM:
        return None
    return "left" if towards_left > 0.0 else "right"


def _further(bodies: Mapping[str, Body], a: str, b: str, axis: int) -> float:
    """How much further (mm) the centre of ``a`` lies along an axis of LPS than ``b``'s; 0 where one is missing."""
    if a not in bodies or b not in bodies:
        return 0.0
    return float(bodies[a].centre[axis] - bodies[b].centre[axis])
