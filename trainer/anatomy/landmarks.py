"""Where the body's axes are, as the bones themselves tell, against what the file says.

A femur lies above its tibia, a patella in front of its femur, and a fibula beside its tibia on the outer side of the
leg. The first two show a file that lies about up or front, or a label map that is not this file's. The third tells
left from right. A mirrored right knee *is* a left knee, so exchanged sides show only where something else says which
knee it is: the label map's ``side``, or the menisci and the tibia's cartilages, whose medial ones must lie away from
the fibula.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from trainer.config import ConfigError
from trainer.geometry import Array

Side = Literal["left", "right"]

#: The centre (3,) of a structure, mm, LPS; None where it is missing.
Centre = Callable[[str], Array | None]

#: Pairs that tell the outer side of the leg: the first lies lateral of the second. The fibula is the surest.
LATERAL_OF = (
    ("fibula", "tibia"),
    ("lateral meniscus", "medial meniscus"),
    ("lateral tibial cartilage", "medial tibial cartilage"),
)
ABOVE = (("femur", "tibia"), ("femoral cartilage", "tibia"), ("patella", "tibia"))
IN_FRONT_OF = (("patella", "femur"), ("patellar cartilage", "femur"), ("patella", "femoral cartilage"))

#: Two centres that are nearer along an axis tell nothing; assumed, a third of what any of the pairs above is apart.
LEAST_MM = 3.0


def side(centre: Centre) -> Side | None:
    """Which knee it is, by the first of LATERAL_OF that is there; None where none is."""
    return next((found for lateral, medial in LATERAL_OF if (found := _side_of(centre, lateral, medial))), None)


def check(centre: Centre, stated: str, name: str) -> None:
    """Raises ConfigError where structures lie as in no knee, or not as in the ``stated`` one (left, right or "")."""
    for upper, lower in ABOVE:
        if _apart(centre, upper, lower, 2, 1.0):
            raise ConfigError(
                f"{name}: the {upper} lies below the {lower}: up and down are exchanged in the file, "
                "or the label map is not this file's"
            )
    for front, back in IN_FRONT_OF:
        if _apart(centre, front, back, 1, -1.0):
            raise ConfigError(
                f"{name}: the {front} lies behind the {back}: front and back are exchanged in the file "
                "(LPS for RAS?), or the label map is not this file's"
            )
    told = side(centre)
    for lateral, medial in LATERAL_OF:
        other = _side_of(centre, lateral, medial)
        if other is not None and other != told:
            raise ConfigError(
                f"{name}: the {lateral} lies medial of the {medial}, judged by the {LATERAL_OF[0][0]}: "
                "medial and lateral are exchanged in the label map"
            )
    if stated and told and stated != told:
        raise ConfigError(
            f"{name}: the label map says a {stated} knee, the bones are a {told} one's: left and right are exchanged "
            "in the file, or it is the other knee"
        )


def _side_of(centre: Centre, lateral: str, medial: str) -> Side | None:
    if _apart(centre, lateral, medial, 0, -1.0):
        return "left"
    return "right" if _apart(centre, lateral, medial, 0, 1.0) else None


def _apart(centre: Centre, a: str, b: str, axis: int, sign: float) -> bool:
    """Whether ``a`` lies clearly on the wrong side of ``b``: further down along ``sign`` times an axis of LPS."""
    ca, cb = centre(a), centre(b)
    return ca is not None and cb is not None and sign * (ca[axis] - cb[axis]) < -LEAST_MM
