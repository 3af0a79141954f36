"""Vessels of a few hundred nodes."""

from __future__ import annotations

from trainer.anatomy.vessel import Tissue, Vessel, build, together
from trainer.config import Sourced
from trainer.curriculum import VesselSpec

MODULUS_kPa = 1000.0
ASSUMED = Sourced(MODULUS_kPa, "assumed")


def vessel(name: str, cut_mm: float, axis: float, layers: int = 9, around: int = 12) -> Vessel:
    spec = VesselSpec(
        name, (cut_mm, 0.0, 0.0), (axis, 0.0, 0.0), 1.0, 0.15, 2.0, layers, around, ASSUMED, ASSUMED, ASSUMED, ASSUMED
    )
    return build(spec)


def two_vessels() -> Tissue:
    """A and B, end to end with a gap between them."""
    return together((vessel("A", -0.2, -1.0), vessel("B", 0.2, 1.0)))
