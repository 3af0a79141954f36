"""Verification of the equilibrium solver against laws, and against the paper's relaxation."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from allocations import ARRAY_HEADER, kept_bytes
from coarse_vessels import MODULUS_kPa, two_vessels, vessel

from trainer.anatomy.vessel import Tissue, together, wall_point
from trainer.geometry import Array, Rigid, quaternion_from_axis_angle
from trainer.mechanics.attachments import Anchors, Cable, Frictions
from trainer.mechanics.equilibrium import Equilibrium
from trainer.mechanics.link_law import j_shaped
from trainer.mechanics.links import forces, link_mesh
from trainer.mechanics.minimise import CABLE_MM, MOST_STEPS, STEP_MM
from trainer.mechanics.relaxation import breadth_first, relax

MOVED = Rigid(np.array([1000.0, -300.0, 20.0]), quaternion_from_axis_angle([1.0, 2.0, -0.5], 1.1))
CORNER = np.array([1.0, 0.0, 0.0])
OPEN = np.zeros(4, dtype=np.bool_)  # no stretch of a cable is a channel


@pytest.fixture(scope="module")
def tissue() -> Tissue:
    return two_vessels()


def state_of(tissue: Tissue) -> Equilibrium:
    return Equilibrium(tissue.mesh, tissue.orders())


def hold(state: Equilibrium, tissue: Tissue, k: int, clock: float, axial: float) -> int:
    nodes, weights = wall_point(tissue.vessels[k], clock, axial, "outer")
    return state.hold(nodes + tissue.offset[k], weights)


def spring(state: Equilibrium, slot: int, move: Array, k: float = 1e4) -> Anchors:
    return Anchors(np.array([slot]), (state.position(slot) + move)[None], k * np.eye(3)[None])


def test_links_with_a_law_of_their_own_are_refused(tissue: Tissue) -> None:
    bent = replace(tissue.mesh, law=j_shaped(tissue.mesh, 20.0, 0.1))
    with pytest.raises(ValueError, match="constant stiffness"):
        Equilibrium(bent, tissue.orders())


def test_nothing_held_nothing_moves(tissue: Tissue) -> None:
    state = state_of(tissue)
    answer = state.solve()
    assert answer.converged
    assert answer.iterations == 0
    assert np.array_equal(state.x, tissue.mesh.rest)


def test_a_state_moved_from_outside_is_evaluated_where_it_is(tissue: Tissue) -> None:
    """What is left of the last solve counts only where it ended: the same hold leads back to the same state.

    Unbalanced forces of 1e-6 mN at the softest stiffness of about 1 mN/mm, twice; and a solve that begins where the
    last one ended has nothing to do.
    """
    state = state_of(tissue)
    anchors = spring(state, hold(state, tissue, 0, 12.0, 0.3), np.array([0.0, 0.0, 0.1]))
    assert state.solve(anchors, tolerance_mN=1e-6).converged
    found = state.x.copy()
    assert state.solve(anchors, tolerance_mN=1e-6).iterations == 0
    state.x[tissue.orders()[0]] += 0.01
    assert state.solve(anchors, tolerance_mN=1e-6).iterations > 0
    assert np.abs(state.x - found).max() < 2e-6


def test_axial_stretch_of_the_tube_against_its_modulus() -> None:
    """k = E A / L of a bar, E the modulus that the links were given, within 10 per cent (0.947 measured).

    The stiffness rule is exact for directions spread evenly over the sphere. The five-way split of a cell is not: in
    bulk it gives 1.2 E along the sides of cubes (test_links), and a wall one cell thick, all surface, relaxes part
    of that. With other proportions of the cells the same rule gives 0.86 to 1.47; this test is of those in use.
    """
    end = vessel("A", 0.0, 1.0, layers=21, around=24)
    tissue = together((end,))
    state = state_of(tissue)
    cut = np.flatnonzero(end.axial_mm == 0.0)
    slots = np.array([state.hold(np.full(3, i), CORNER) for i in cut])
    along = np.array([state.position(s) for s in slots]) - 0.002 * end.axis
    stiffness = np.broadcast_to(1e6 * np.outer(end.axis, end.axis), (len(slots), 3, 3))
    answer = state.solve(Anchors(slots, along, stiffness), tolerance_mN=1e-5)
    assert answer.converged
    bar = MODULUS_kPa * np.pi * (0.5**2 - 0.35**2) / 2.0
    measured = -float((answer.anchor_force @ end.axis).sum()) / 0.002
    assert 0.9 < measured / bar < 1.1


@pytest.mark.parametrize("move", [(0.0, 0.0, -0.15), (0.0, 0.0, 0.3), (0.0, 0.2, 0.0), (0.3, 0.0, 0.0)])
def test_agrees_with_the_paper_s_relaxation(tissue: Tissue, move: tuple[float, float, float]) -> None:
    """Two ways to one equilibrium: a residual of 1e-8 mN at the softest stiffness, about 1 mN/mm, is 1e-8 mm."""
    mesh, node = tissue.mesh, tissue.vessels[0].node(2, 0)
    state = state_of(tissue)
    answer = state.solve(spring(state, state.hold(np.full(3, node), CORNER), np.array(move)), tolerance_mN=1e-8)
    assert answer.converged
    x = mesh.rest.copy()
    x[node] = state.x[node]
    assert relax(mesh, x, np.array([node]), tolerance_mN=1e-8, most_sweeps=100_000).converged
    assert np.abs(state.x - mesh.rest).max() > 0.1
    assert np.abs(x - state.x).max() < 1e-6


def test_relaxation_region_and_cut_off(tissue: Tissue) -> None:
    """Nodes beyond the region stay; with a cut-off nothing moves where forces below it arrive."""
    mesh, node = tissue.mesh, tissue.vessels[0].node(2, 0)
    order = breadth_first(mesh, np.array([node]), most_links=2)
    one = set(mesh.neighbour[mesh.start[node] : mesh.start[node + 1]])
    two = {int(j) for i in one for j in mesh.neighbour[mesh.start[i] : mesh.start[i + 1]]}
    assert set(order) == (one | two) - {node}
    assert set(order[: len(one)]) == one
    x = mesh.rest.copy()
    x[node, 2] += 0.05
    relax(mesh, x, np.array([node]), tolerance_mN=1e-9, most_sweeps=50, most_links=2)
    assert {int(i) for i in np.flatnonzero(np.any(x != mesh.rest, axis=1))} <= one | two | {node}
    x = mesh.rest.copy()
    x[node, 2] += 0.05
    relax(mesh, x, np.array([node]), tolerance_mN=1e-9, most_sweeps=50, cut_off_mN=1e3)
    assert np.flatnonzero(np.any(x != mesh.rest, axis=1)).tolist() == [node]


def test_relaxation_stops_when_its_caller_has_no_time(tissue: Tissue) -> None:
    x = tissue.mesh.rest.copy()
    x[0, 2] += 0.1
    answer = relax(
        tissue.mesh, x, np.array([0]), tolerance_mN=0.0, most_sweeps=1000, out_of_time=iter([False, True]).__next__
    )
    assert not answer.converged
    assert answer.sweeps == 10


def test_an_anchor_s_force_is_what_the_tissue_and_its_clamps_give_back(tissue: Tissue) -> None:
    """Balance of the whole vessel: anchor + forces of the links on the fixed nodes' supports = 0 within the residual.

    The residual vector of Euclidean norm 1e-7 over 200 nodes adds up to at most 1e-7 √200.
    """
    state = state_of(tissue)
    slot = hold(state, tissue, 0, 0.4, 0.35)
    answer = state.solve(spring(state, slot, np.array([0.1, 0.05, -0.1])), tolerance_mN=1e-7)
    support = -forces(tissue.mesh, state.x)[tissue.mesh.fixed].sum(axis=0)
    assert np.linalg.norm(answer.anchor_force) > 0.5
    assert np.abs(answer.anchor_force[0] + support).max() < 2e-6


def sliding(state: Equilibrium, slot: int, force: Array) -> Frictions:
    """Friction that is overcome by far: it gives its limit, which is ``force`` (3,) mN."""
    size = float(np.linalg.norm(force))
    place = state.position(slot) + 10.0 * force / size
    return Frictions(np.array([slot]), place[None], force[None] / size, np.array([1e3]), np.array([size]))


def test_sliding_friction_and_anchor_are_two_sides_of_one_equilibrium(tissue: Tissue) -> None:
    """The force that an anchor gave, given by what slides past, leads to the same place."""
    state = state_of(tissue)
    slot = hold(state, tissue, 1, 0.0, 0.35)
    answer = state.solve(spring(state, slot, np.array([0.0, 0.0, -0.1])), tolerance_mN=1e-8)
    held = state.x.copy()
    answer = state.solve(frictions=sliding(state, slot, answer.anchor_force[0]), tolerance_mN=1e-8)
    assert answer.converged
    assert np.abs(state.x - held).max() < 1e-6


@pytest.mark.parametrize("stiffness", [1.0, 1e2, 1e4])
def test_friction_draws_until_it_slides_and_never_overshoots(tissue: Tissue, stiffness: float) -> None:
    """A point between a friction k, at most F, and a spring K whose ends part by s goes k s / (k + K) until that is
    F / K, whatever the ratio of k and K: K follows from the first, small, way.

    The tissue is hardly bent at 0.1 mN: its own stiffness changes by less than a hundredth.
    """
    state = state_of(tissue)
    slot, limit, along = hold(state, tissue, 1, 0.0, 0.35), 0.1, np.array([0.0, 0.0, 1.0])
    rest = state.position(slot)

    def drawn(way: float) -> float:
        rub = Frictions(
            np.array([slot]), (rest + way * along)[None], along[None], np.array([stiffness]), np.array([limit])
        )
        assert state.solve(frictions=rub, tolerance_mN=1e-9, max_iterations=200).converged
        return float((state.position(slot) - rest) @ along)

    little = 1e-3 * limit / stiffness
    own = stiffness * (little / drawn(little) - 1.0)
    slides_at = limit / stiffness + limit / own
    assert drawn(0.5 * slides_at) == pytest.approx(0.5 * limit / own, rel=0.01)
    for way in (2.0 * slides_at, 100.0 * slides_at):
        assert drawn(way) == pytest.approx(limit / own, rel=0.01)
    assert drawn(-2.0 * slides_at) == pytest.approx(-limit / own, rel=0.01)


def test_a_hole_slides_along_a_needle(tissue: Tissue) -> None:
    """An anchor k (I - t tᵀ) gives no force along t."""
    state = state_of(tissue)
    slot, t = hold(state, tissue, 0, 0.0, 0.35), np.array([0.6, 0.0, 0.8])
    target = state.position(slot) + np.array([0.1, 0.05, 0.0])
    answer = state.solve(Anchors(np.array([slot]), target[None], 1e4 * (np.eye(3) - np.outer(t, t))[None]))
    assert answer.converged
    assert np.linalg.norm(answer.anchor_force) > 0.1
    assert abs(answer.anchor_force[0] @ t) < 1e-9


def test_a_cable_between_the_ends_keeps_its_length_and_pulls_both_alike(tissue: Tissue) -> None:
    """Path no longer than the thread within CABLE_MM; equal and opposite pulls; the mirror image moves alike.

    Tension is checked on the clamps of each vessel: residual 1e-6 over √200 nodes.
    """
    state = state_of(tissue)
    a, b = hold(state, tissue, 0, 0.0, 0.35), hold(state, tissue, 1, 0.0, 0.35)
    gap = float(np.linalg.norm(state.position(a) - state.position(b)))
    cable = Cable(np.array([a, b]), np.zeros((2, 3)), gap - 0.3, OPEN[:2])
    answer = state.solve(cables=(cable,), tolerance_mN=1e-6)
    assert answer.converged
    line = state.position(b) - state.position(a)
    assert abs(np.linalg.norm(line) - cable.length_mm) <= CABLE_MM
    pulled = answer.tension[0] * line / np.linalg.norm(line)
    support = -forces(tissue.mesh, state.x)
    for k, pull in ((0, pulled), (1, -pulled)):
        fixed = np.flatnonzero(tissue.mesh.fixed[tissue.nodes(k)]) + tissue.offset[k]
        assert np.abs(support[fixed].sum(axis=0) + pull).max() < 2e-5
    moved = state.x - tissue.mesh.rest
    assert answer.tension[0] > 1.0
    assert np.abs(moved[tissue.nodes(0)] * (-1, 1, 1) - moved[tissue.nodes(1)]).max() < 1e-4


def test_a_slack_cable_does_nothing_and_a_taut_one_turns_round_a_hole(tissue: Tissue) -> None:
    """Interior point: tension times the sum of the two unit vectors away from it."""
    state = state_of(tissue)
    a = hold(state, tissue, 0, 0.0, 0.35)
    ends = state.position(a) + np.array([[1.0, 0.0, 0.6], [0.0, 0.0, 0.0], [0.2, 0.8, 0.6]])
    path = float(np.linalg.norm(ends[0] - ends[1]) + np.linalg.norm(ends[2] - ends[1]))
    slots = np.array([-1, a, -1])
    answer = state.solve(cables=(Cable(slots, ends, path + 0.01, OPEN[: len(slots)]),))
    assert answer.tension.tolist() == [0.0]
    assert np.array_equal(state.x, tissue.mesh.rest)
    answer = state.solve(cables=(Cable(slots, ends, path - 0.1, OPEN[: len(slots)]),), tolerance_mN=1e-6)
    assert answer.converged
    assert answer.cable_error_mm <= CABLE_MM
    p = state.position(a)
    away = [(e - p) / np.linalg.norm(e - p) for e in (ends[0], ends[2])]
    support = -forces(tissue.mesh, state.x)[tissue.mesh.fixed].sum(axis=0)
    assert np.abs(support + answer.tension[0] * (away[0] + away[1])).max() < 2e-5


def test_a_thread_does_not_draw_the_two_holes_of_its_channel_together(tissue: Tissue) -> None:
    """In through the outer wall, out by the inner one: each hole is pulled by the thread outside the channel alone.

    The pull of the whole thread on the tissue, read off the clamps, is T times the two unit vectors outside the
    channel; residual 1e-6 over √200 nodes. Path and length leave the channel out.
    """
    state = state_of(tissue)
    outer = hold(state, tissue, 0, 0.0, 0.5)
    nodes, weights = wall_point(tissue.vessels[0], 0.0, 0.5, "inner")
    inner = state.hold(nodes, weights)
    slots = np.array([-1, outer, inner, -1])
    ends = np.array([state.position(outer) + np.array([0.8, 0.0, 0.8]), np.zeros(3), np.zeros(3), (0.5, 0.0, 0.2)])
    outside = float(np.linalg.norm(ends[0] - state.position(outer)) + np.linalg.norm(ends[3] - state.position(inner)))
    channel = np.array([False, True, False, False])
    answer = state.solve(cables=(Cable(slots, ends, outside - 0.05, channel),), tolerance_mN=1e-6)
    assert answer.converged
    assert answer.tension[0] > 0.1
    ways = [ends[0] - state.position(outer), ends[3] - state.position(inner)]
    assert sum(np.linalg.norm(w) for w in ways) == pytest.approx(outside - 0.05, abs=CABLE_MM)
    pull = answer.tension[0] * sum(w / np.linalg.norm(w) for w in ways)
    support = -forces(tissue.mesh, state.x)[tissue.mesh.fixed].sum(axis=0)
    assert np.abs(support + pull).max() < 2e-5


@pytest.mark.parametrize("what", ["anchor", "cable"])
def test_the_answer_does_not_depend_on_where_the_scene_stands(tissue: Tissue, what: str) -> None:
    """Moved by 1 m and turned: the same forces to 1e-6, given a residual of 1e-7 mN in forces above 0.1 mN."""
    moved = replace(tissue, mesh=replace(tissue.mesh, rest=MOVED.apply(tissue.mesh.rest)))
    answers = []
    for t, rotate in ((tissue, lambda v: v), (moved, MOVED.rotate)):
        state = state_of(t)
        a, b = hold(state, t, 0, 0.3, 0.35), hold(state, t, 1, 0.1, 0.4)
        if what == "anchor":
            answer = state.solve(spring(state, a, rotate(np.array([0.05, 0.02, -0.08]))), tolerance_mN=1e-7)
            force = answer.anchor_force[0]
            answers.append(MOVED.inverse().rotate(force) if t is moved else force)
        else:
            cable = Cable(np.array([a, b]), np.zeros((2, 3)), 1.0, OPEN[:2])
            answers.append(state.solve(cables=(cable,), tolerance_mN=1e-7).tension)
        assert np.abs(answers[-1]).max() > 0.1
    assert np.abs(answers[0] - answers[1]).max() < 1e-6 * np.abs(answers[0]).max()


def test_a_leap_of_20_mm_stays_finite_and_is_followed_in_steps(tissue: Tissue) -> None:
    """A held point moves at most MOST_STEPS · STEP_MM in one solve, which is said; let go, the vessel is at rest."""
    state = state_of(tissue)
    slot = hold(state, tissue, 0, 0.0, 0.35)
    start = state.position(slot)
    away = spring(state, slot, np.array([0.0, 0.0, -20.0]))
    answer = state.solve(away, max_iterations=20)
    assert not answer.converged
    assert answer.reached == pytest.approx(MOST_STEPS * STEP_MM / 20.0)
    assert np.linalg.norm(state.position(slot) - start) < MOST_STEPS * STEP_MM + 0.01
    for _ in range(3):
        state.solve(away, max_iterations=20)
        assert np.all(np.isfinite(state.x))
    back = Anchors(np.array([slot]), start[None], 1e4 * np.eye(3)[None])
    assert [state.solve(back, tolerance_mN=1e-4).converged for _ in range(10)][-1]
    state.drop(slot)
    assert state.solve().converged
    assert np.array_equal(state.x, tissue.mesh.rest)


def test_what_is_held_a_million_times_stiffer_than_the_tissue_is_drawn_as_well() -> None:
    """Out and back by 0.02 mm at a time: each equilibrium is found, and a hundred times stiffer than another hold this
    one is the same but for what the other gives way, F / k; no more than 1e-4 mm then remain to either's residual."""
    whole = vessel("A", 0.0, -1.0, layers=31, around=32)
    mesh, node = whole.mesh, whole.node(15, 0)
    ways = [0.02 * k * whole.twelve for k in (1, 2, 3, 4, 5, 6, 7, 6, 5, 4, 3, 2, 1)]
    found = []
    for stiffness in (1e7, 1e9):
        state = Equilibrium(mesh, (whole.elimination,))
        slot = np.array([state.hold(np.full(3, node), CORNER)])
        answers = []
        for way in ways:
            held = Anchors(slot, (mesh.rest[node] + way)[None], stiffness * np.eye(3)[None])
            answer = state.solve(held, tolerance_mN=3e-4)
            assert answer.converged
            answers.append((state.x.copy(), np.linalg.norm(answer.anchor_force)))
        found.append(answers)
    for (one, force), (other, _) in zip(*found, strict=True):
        assert np.linalg.norm(one - other, axis=1).max() < force / 1e7 + 1e-4


@pytest.mark.parametrize("bend_mm", [-0.6, 0.5])
def test_a_factor_made_anew_changes_the_way_and_not_the_answer(tissue: Tissue, bend_mm: float) -> None:
    """A bent end, moved about until its stiffness was factored where it is: fewer iterations to the same place.

    Both states have a residual below 1e-7 mN, at a stiffness of about 1 mN/mm: 1e-6 mm is ample. A point held
    since the beginning and one held meanwhile take part.
    """
    state, kept = state_of(tissue), state_of(tissue)
    kept.compliance.refresh = lambda bodies, x: None  # type: ignore[method-assign]
    iterations = []
    for s in (state, kept):
        slot = hold(s, tissue, 0, 0.0, 0.0)
        start = s.position(slot)
        used = []
        for i in range(80):
            if i == 30:
                more = hold(s, tissue, 0, 2.0, 0.3)
            move = np.array([0.02 * np.sin(0.4 * i), 0.02 * np.cos(0.3 * i), bend_mm * min(1.0, (i + 1) / 12)])
            rub = sliding(s, more, np.array([0.0, 0.1, 0.0])) if i >= 30 else None
            anchor = Anchors(np.array([slot]), (start + move)[None], 1e4 * np.eye(3)[None])
            answer = s.solve(anchor, frictions=rub, tolerance_mN=1e-7, max_iterations=300)
            assert answer.converged
            used.append(answer.iterations)
        iterations.append(np.median(used[-20:]))
    assert iterations[0] < 0.6 * iterations[1]
    assert np.abs(state.x - kept.x).max() < 1e-6


@pytest.mark.parametrize(
    "held",
    [
        lambda a: {"anchors": Anchors(np.array([a]), np.full((1, 3), np.nan), np.eye(3)[None])},
        lambda a: {
            "frictions": Frictions(np.array([a]), np.full((1, 3), np.inf), np.eye(3)[:1], np.ones(1), np.ones(1))
        },
        lambda a: {"cables": (Cable(np.array([a, -1]), np.full((2, 3), np.nan), 1.0, OPEN[:2]),)},
    ],
)
def test_what_is_not_finite_is_refused(tissue: Tissue, held: Callable[[int], dict[str, object]]) -> None:
    state = state_of(tissue)
    slot = hold(state, tissue, 0, 0.0, 0.35)
    with pytest.raises(ValueError, match="not finite"):
        state.solve(**held(slot))  # type: ignore[arg-type]
    assert np.array_equal(state.x, tissue.mesh.rest)


def test_two_runs_give_the_same_bits(tissue: Tissue) -> None:
    def run() -> Array:
        state = state_of(tissue)
        a, b = hold(state, tissue, 0, 0.0, 0.35), hold(state, tissue, 1, 0.0, 0.35)
        for i in range(30):
            move = np.array([0.0, 0.1 * np.sin(0.3 * i), -0.02 * i])
            anchor = Anchors(np.array([a]), (tissue.mesh.rest[0] + move)[None], 1e3 * np.eye(3)[None])
            state.solve(anchor, (Cable(np.array([a, b]), np.zeros((2, 3)), 0.9, OPEN[:2]),))
        return state.x

    assert np.array_equal(run(), run())


def test_a_body_that_is_left_in_peace_stays_at_rest_to_the_last_bit() -> None:
    """Three vessels, of which any may be held: the others lie as they were built, and the held ones do not care."""
    three = together((vessel("A", -2.5, -1.0), vessel("B", 0.0, 1.0), vessel("C", 2.5, 1.0)))
    state = state_of(three)
    slots = [hold(state, three, k, 0.0, 0.4) for k in range(3)]
    place_of = [state.position(s) for s in slots]
    move = np.array([0.0, 0.0, -0.05])
    alone = state_of(three)
    alone.solve(spring(alone, hold(alone, three, 0, 0.0, 0.4), move), tolerance_mN=1e-8)
    for awake in ((0, 1, 2), (0, 2), (0,), (1,), (0, 2), (2,), (0, 1, 2), (0,)):
        rest = three.mesh.rest
        anchors = Anchors(
            np.array([slots[k] for k in awake]),
            np.array([place_of[k] + move for k in awake]),
            np.repeat(1e4 * np.eye(3)[None], len(awake), axis=0),
        )
        for _ in range(3):
            state.solve(anchors, tolerance_mN=1e-8)
        for k in range(3):
            if k not in awake:
                assert np.array_equal(state.x[three.nodes(k)], rest[three.nodes(k)]), (awake, k)
        if 0 in awake:
            # Residual 1e-8 mN against a least stiffness of about 1 mN/mm.
            assert np.abs(state.x[three.nodes(0)] - alone.x[three.nodes(0)]).max() < 1e-7


def test_a_body_may_begin_with_nodes_that_are_fixed(tissue: Tissue) -> None:
    """The same vessel with its numbering turned round, clamp first: the same answer, node by node."""
    one = together((vessel("A", 0.0, -1.0),))
    n = len(one.mesh.rest)
    turned = link_mesh(one.mesh.rest[::-1], (n - 1 - one.mesh.links)[:, ::-1], one.mesh.stiffness, one.mesh.fixed[::-1])
    assert turned.fixed[0]
    nodes, weights = wall_point(one.vessels[0], 0.0, 0.4, "outer")
    answers = []
    for mesh, order, at in ((one.mesh, one.orders()[0], nodes), (turned, n - 1 - one.orders()[0], n - 1 - nodes)):
        state = Equilibrium(mesh, (np.ascontiguousarray(order, dtype=np.int32),))
        state.solve(spring(state, state.hold(at, weights), np.array([0.0, 0.0, -0.1])), tolerance_mN=1e-8)
        answers.append(state.x)
    assert np.abs(answers[0] - answers[1][::-1]).max() < 1e-7  # as above


def tiny() -> Array:
    """Where anchor, cable and friction leave a coarse tissue, each solve after the other: (8, n, 3) mm. A node at the
    cut edge loses its links on the way."""
    coarse = together((vessel("A", -0.2, -1.0, 4, 6), vessel("B", 0.2, 1.0, 4, 6)))
    state = state_of(coarse)
    a, b = hold(state, coarse, 0, 0.0, 0.35), hold(state, coarse, 1, 0.0, 0.35)
    start, along = state.position(a), np.array([0.0, 0.0, 1.0])
    gap, found = float(np.linalg.norm(state.position(b) - start)), []
    for k in range(8):
        if k == 6:
            state.cut(coarse.mesh.via[coarse.mesh.start[3] : coarse.mesh.start[4]])
        anchors = Anchors(np.array([a]), (start - 0.02 * k * along)[None], 1e3 * np.eye(3)[None])
        rub = Frictions(
            np.array([b]), state.position(b)[None] + 0.02 * along, along[None], np.full(1, 50.0), np.ones(1)
        )
        cable = Cable(np.array([a, b]), np.zeros((2, 3)), gap - 0.02 * k, OPEN[:2])
        assert state.solve(anchors, (cable,) if k > 3 else (), rub, tolerance_mN=1e-8, max_iterations=200).converged
        found.append(state.x.copy())
    return np.array(found)


def test_without_compilation_the_same_answer(tmp_path: Path) -> None:
    """Sums in another order steer the iterations; all end within 1e-8 mN, over a least stiffness of 0.1 mN/mm."""
    script = (
        "import sys, numpy; sys.path[:0] = sys.argv[1:2];"
        "import test_equilibrium as t; numpy.save(sys.argv[2], t.tiny())"
    )
    run = [sys.executable, "-c", script, str(Path(__file__).parent), str(tmp_path / "tiny.npy")]
    subprocess.run(run, check=True, env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, timeout=120)
    assert np.abs(np.load(tmp_path / "tiny.npy") - tiny()).max() < 2e-7


def test_what_is_held_in_turn_is_held_as_if_alone(tissue: Tissue) -> None:
    """Layouts of solves are kept: those of equal size must not take each other's points. Residual 1e-8 mN against a
    least stiffness of about 1 mN/mm, and each of two states is that far off."""
    state = state_of(tissue)
    slots = [hold(state, tissue, 0, clock, 0.35) for clock in (0.0, 1.0)]
    move = np.array([0.0, 0.0, -0.05])
    springs = [spring(state, slot, move) for slot in slots]
    for n in (0, 1, 0, 1):
        state.solve(springs[n], tolerance_mN=1e-8)
        alone = state_of(tissue)
        alone.solve(spring(alone, hold(alone, tissue, 0, (0.0, 1.0)[n], 0.35), move), tolerance_mN=1e-8)
        assert np.abs(state.x - alone.x).max() < 2e-8


def test_a_solve_allocates_no_array_of_the_tissue(tissue: Tissue) -> None:
    """What a solve answers is less than a vector (n, 3) of all nodes; and it keeps nothing."""
    state = state_of(tissue)
    slot = hold(state, tissue, 0, 0.0, 0.35)
    there, back = spring(state, slot, np.array([0.0, 0.0, -0.02])), spring(state, slot, np.zeros(3))

    def to_and_fro() -> None:
        state.solve(there)
        state.solve(back)

    kept, most = kept_bytes(to_and_fro)
    assert kept < ARRAY_HEADER
    assert most < state.x.nbytes
