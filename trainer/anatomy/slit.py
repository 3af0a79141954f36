"""Which links of a vessel's wall a slit crosses that runs from the cut edge along the vessel."""

from __future__ import annotations

import numpy as np

from trainer.anatomy.vessel import Vessel

#: Links of a wall reach over less than this angle, rad: what lies further aside crosses the plane behind the axis.
ASIDE = 0.5 * np.pi


def slit_links(vessel: Vessel, hulls: tuple[str, ...], clocks: tuple[float, float], axial_mm: float) -> np.ndarray:
    """The links (k,) of the vessel's mesh that a slit crosses, no further than ``axial_mm`` from the cut edge, and that
    have an end in one of ``hulls`` (outer, inner).

    At rest; the slit is at ``clocks`` rad in the outer hull and in the inner one, and a node is on the one side of it
    or on the other by the hour of its own hull. So where both hulls are slit, be it one after the other and at two
    hours, no link is left across. A node at the slit's hour is beyond it.
    """
    links = vessel.mesh.links
    inner = links // vessel.spec.around % 2
    turned = (vessel.clock[links] - np.array(clocks)[inner] + np.pi) % (2.0 * np.pi) - np.pi
    crosses = ((turned[:, 0] < 0.0) != (turned[:, 1] < 0.0)) & np.all(np.abs(turned) < ASIDE, axis=1)
    of_hulls = np.isin(inner, [("outer", "inner").index(hull) for hull in hulls]).any(axis=1)
    at = np.flatnonzero(crosses & of_hulls)
    a, b = turned[at].T
    one, other = vessel.axial_mm[links[at]].T
    return np.asarray(at[one + a / (a - b) * (other - one) <= axial_mm])
