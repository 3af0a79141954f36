"""The links across a slit: none is left where both hulls are slit, and no other is cut."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from trainer.anatomy.slit import slit_links
from trainer.anatomy.vessel import build
from trainer.config import Sourced
from trainer.curriculum import VesselSpec

GIVEN = Sourced(1.0, "assumed")
AROUND = 12
VESSEL = build(VesselSpec("A", (0, 0, 0), (-1, 0, 0), 1.0, 0.15, 2.0, 9, AROUND, GIVEN, GIVEN, GIVEN, GIVEN))
LINKS, NODES = VESSEL.mesh.links, np.arange(len(VESSEL.mesh.rest))
INNER = NODES // AROUND % 2  # 1 in the inner hull
TENTH = math.pi / 1800.0
#: Hours, rad, of which none is a node's: on which side such a node is, rounding would tell.
hours = st.integers(0, 3599).map(lambda tenths: (tenths + 0.5) * TENTH)


def beyond(clocks: tuple[float, float]) -> np.ndarray:
    """Which nodes (n,) are in the half turn after the hour of their hull."""
    return np.array([(h - clocks[i]) % (2.0 * math.pi) < math.pi for h, i in zip(VESSEL.clock, INNER, strict=True)])


@settings(max_examples=50)
@given(outer=hours, apart=st.integers(-400, 400).map(lambda tenths: tenths * TENTH))
def test_two_slits_along_the_whole_vessel_leave_two_halves(outer: float, apart: float) -> None:
    """At any hour, and up to 40° further in the inner hull than in the outer one, which is slit first; and again on the
    opposite side. What hangs together is then what lies between the two slits, each hull by its own hours."""
    clocks = outer, outer + apart
    cut = np.zeros(len(LINKS), dtype=np.bool_)
    for turn in (0.0, math.pi):
        cut[slit_links(VESSEL, ("outer",), (outer + turn, outer + turn), 2.0)] = True
        cut[slit_links(VESSEL, ("inner",), (outer + turn, outer + apart + turn), 2.0)] = True
    i, j = LINKS[~cut].T
    _, piece = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(len(NODES), len(NODES))), False)
    half = beyond(clocks)
    assert not set(piece[half]) & set(piece[~half])


@settings(max_examples=50)
@given(clock=hours, axial=st.floats(0.0, 2.0), walls=st.sampled_from([("outer",), ("inner",), ("outer", "inner")]))
def test_a_slit_cuts_what_it_crosses_and_nothing_else(clock: float, axial: float, walls: tuple[str, ...]) -> None:
    """Of the links of its walls those that go from one side of its hour to the other, no further in than it reaches: by
    the point at which the link is nearest to the hour, found in a thousand steps along it, to one step's length."""
    cut = set(slit_links(VESSEL, walls, (clock, clock), axial).tolist())
    share = np.linspace(0.0, 1.0, 1001)
    for e, (a, b) in enumerate(LINKS.tolist()):
        one, other = (math.remainder(VESSEL.clock[k] - clock, 2.0 * math.pi) for k in (a, b))
        crosses = (one < 0.0) != (other < 0.0) and abs(one - other) < math.pi
        of_walls = bool({("outer", "inner")[INNER[k]] for k in (a, b)} & set(walls))
        if e in cut:
            assert crosses
            assert of_walls
        if crosses and of_walls:
            nearest = share[np.argmin(np.abs(one + share * (other - one)))]
            at = VESSEL.axial_mm[a] + nearest * (VESSEL.axial_mm[b] - VESSEL.axial_mm[a])
            if abs(at - axial) > VESSEL.layer_mm / 1000.0:
                assert (e in cut) == (at < axial)


def test_each_slit_opens_the_cut_edge() -> None:
    """However short it is: what tears out comes free."""
    for clock in np.linspace(0.0, 2.0 * math.pi, 50):
        cut = LINKS[slit_links(VESSEL, ("outer",), (clock, clock), 0.0)]
        assert (VESSEL.axial_mm[cut] == 0.0).all(axis=1).any()
