"""Verification of cuts: what is left is in the equilibrium of the mesh that was never joined there."""

from __future__ import annotations

from time import sleep

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.anatomy.vessel import build
from trainer.config import Sourced
from trainer.curriculum import VesselSpec
from trainer.geometry import Array, Rigid, quaternion_from_axis_angle
from trainer.mechanics.attachments import Anchors
from trainer.mechanics.compliance import LAG, LASTS
from trainer.mechanics.equilibrium import Equilibrium, Result
from trainer.mechanics.links import LinkMesh, energy, forces, hessian, link_mesh
from trainer.mechanics.loose_pieces import loose_pieces, unstrained

GIVEN = Sourced(1000.0, "assumed")
CORNER = np.array([1.0, 0.0, 0.0])
#: What jaws hold with in a scene, mN/mm, and when a tick's solve ends.
JAWS, TICK_mN, TICK_ITERATIONS = 1.5e4, 0.01, 8
VESSEL = build(VesselSpec("A", (0, 0, 0), (-1, 0, 0), 1.0, 0.15, 2.0, 9, 12, GIVEN, GIVEN, GIVEN, GIVEN))
MESH = VESSEL.mesh


def state_of(mesh: LinkMesh) -> Equilibrium:
    return Equilibrium(mesh, (VESSEL.elimination[~mesh.fixed[VESSEL.elimination]],))


def without(links: np.ndarray, mesh: LinkMesh = MESH) -> LinkMesh:
    """The mesh as if it had been built without these links."""
    kept = np.setdiff1d(np.arange(len(mesh.links)), links)
    return link_mesh(mesh.rest, mesh.links[kept], mesh.stiffness[kept], mesh.fixed)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The links from nodes of ``a`` (n,) bool to nodes of ``b``."""
    i, j = MESH.links.T
    return np.flatnonzero((a[i] & b[j]) | (b[i] & a[j]))


def layer() -> np.ndarray:
    return np.arange(len(MESH.rest)) // (2 * VESSEL.spec.around)


def slit(layers: int) -> np.ndarray:
    """Links across a slit between the last hour and twelve o'clock, so many layers long."""
    hour = np.arange(len(MESH.rest)) % VESSEL.spec.around
    inside = layer() < layers
    return between(inside & (hour == VESSEL.spec.around - 1), inside & (hour == 0))


def grip(state: Equilibrium, nodes: list[int]) -> np.ndarray:
    return np.array([state.hold(np.full(3, node), CORNER) for node in nodes])


def anchors(slots: np.ndarray, places: Array) -> Anchors:
    return Anchors(slots, places, np.repeat(JAWS * np.eye(3)[None], len(slots), axis=0))


def tick(state: Equilibrium, slots: np.ndarray, places: Array) -> Result:
    return state.solve(anchors(slots, places), tolerance_mN=TICK_mN, max_iterations=TICK_ITERATIONS)


def lip() -> list[int]:
    return [VESSEL.node(0, 0), VESSEL.node(1, 0), VESSEL.node(0, 1)]


def least(mesh: LinkMesh, x: Array, held: list[int]) -> float:
    """The least stiffness, mN/mm, of the mesh at ``x`` with jaws on the nodes ``held``."""
    stiffness = hessian(mesh, x)
    for node in held:
        stiffness[3 * node : 3 * node + 3, 3 * node : 3 * node + 3] += JAWS * np.eye(3)
    free = np.repeat(~mesh.fixed, 3)
    found = float(np.linalg.eigvalsh(stiffness[np.ix_(free, free)])[0])
    assert found > 0.0
    return found


NEAR_A_NODE = np.argsort(np.linalg.norm(MESH.rest[MESH.links].mean(axis=1) - MESH.rest[VESSEL.node(3, 2)], axis=1))


@pytest.mark.parametrize(
    "links",
    [slit(3), slit(8), NEAR_A_NODE[2::3][:6], np.arange(5, len(MESH.links), 23)],
    ids=["slit", "long slit", "near a node", "everywhere"],
)
def test_the_equilibrium_after_a_cut_is_that_of_a_mesh_built_without_the_links(links: np.ndarray) -> None:
    """Cut while it is drawn; the other was never joined there.

    Of two states whose residuals have norms r, and between which the least stiffness is λ, the distance is at most
    2 r / λ. λ is that of the mesh without the links and with what holds it, where they are; twice, for its change on
    the way. The whole mesh lies elsewhere: the cut did something.
    """
    tolerance, way = 1e-7, np.array([0.05, 0.08, 0.15])
    found = []
    for mesh, cut in ((MESH, links), (without(links), links[:0]), (MESH, links[:0])):
        state = state_of(mesh)
        slots = grip(state, lip())
        for share in (0.5, 1.0):
            held = anchors(slots, MESH.rest[lip()] + share * way)
            assert state.solve(held, tolerance_mN=1e-3, max_iterations=300).converged
        state.cut(cut)
        for _ in range(2 * LAG):  # over the change of factors
            last = state.solve(held, tolerance_mN=tolerance, max_iterations=300)
        assert last.converged
        found.append(state.x.copy())
    cut_open, never_joined, whole = found
    assert np.linalg.norm(cut_open - never_joined) <= 2.0 * 2.0 * tolerance / least(without(links), cut_open, lip())
    assert np.abs(cut_open - whole).max() > 1e-3


def test_a_tube_cut_through_falls_apart_into_two_that_are_each_in_equilibrium() -> None:
    """Clamped at both ends and drawn on both sides of the cut, which runs all around.

    Forces: in each half those of its own anchor and of its own clamp add up to nothing, within the residual's norm
    times √n for n nodes. Before, they do not: the halves pull at each other. And what is done to the one half then
    moves no node of the other further than the residuals leave open, 2 r / λ as above; before, it does.
    """
    tolerance = 1e-6
    mesh = link_mesh(MESH.rest, MESH.links, MESH.stiffness, (layer() == 0) | (layer() == 8))
    one, other = layer() <= 4, layer() > 4
    nodes = [VESSEL.node(3, 2), VESSEL.node(6, 8)]
    ways = np.array([[-0.05, 0.1, 0.1], [0.05, -0.1, 0.05]])

    def pulled(state: Equilibrium, slots: np.ndarray, moved: Array) -> tuple[Array, list[float]]:
        """Where all nodes are, and what anchor and clamp of each half leave over."""
        held = anchors(slots, mesh.rest[nodes] + moved)
        for _ in range(2):
            ended = state.solve(held, tolerance_mN=tolerance, max_iterations=300)
        assert ended.converged
        support = -forces(state.mesh, state.x)
        sums = [ended.anchor_force[k] + support[half & mesh.fixed].sum(axis=0) for k, half in enumerate((one, other))]
        return state.x.copy(), [float(np.linalg.norm(total)) for total in sums]

    state = state_of(mesh)
    slots = grip(state, nodes)
    joined, left_over = pulled(state, slots, ways)
    assert min(left_over) > 0.1
    assert np.abs(pulled(state, slots, ways * [[1.0], [2.0]])[0] - joined)[one].max() > 1e-3
    state.cut(between(one, other))
    apart, left_over = pulled(state, slots, ways)
    assert max(left_over) <= tolerance * np.sqrt(len(mesh.rest))
    left_open = 2.0 * 2.0 * tolerance / least(without(between(one, other), mesh), apart, nodes)
    assert np.abs(pulled(state, slots, ways * [[1.0], [2.0]])[0] - apart)[one].max() <= left_open
    assert loose_pieces(state.mesh) == []


def test_a_piece_that_came_off_goes_where_it_is_held_and_else_stays() -> None:
    """The near half of a vessel, cut off and held by three points of a rigid motion: it makes that motion.

    Its links then bear nothing, and neither do the springs; the clamped half is where nothing holds it, at rest. Both
    to 2 r / λ as above. Let go, every node stays, to the last bit, whatever is done to the clamped half; held again, it
    goes on.
    """
    tolerance = 1e-7
    off, on = layer() < 4, layer() >= 4
    state = state_of(MESH)
    held = [VESSEL.node(1, 0), VESSEL.node(2, 4), VESSEL.node(1, 8)]
    slots = grip(state, held)
    state.cut(between(off, on))
    (piece,) = loose_pieces(state.mesh)
    assert np.array_equal(piece, np.flatnonzero(off))
    for k in range(1, 31):
        motion = Rigid(
            np.array([0.03, 0.02, 0.01]) * k, quaternion_from_axis_angle([0.3, 1.0, 0.2], np.radians(1.5) * k)
        )
        ended = state.solve(anchors(slots, motion.apply(MESH.rest[held])), tolerance_mN=tolerance, max_iterations=300)
        assert ended.converged
    left_open = 2.0 * 2.0 * tolerance / least(without(between(off, on)), state.x, held)
    assert np.abs(state.x - motion.apply(MESH.rest))[off].max() <= left_open
    assert np.abs(state.x - MESH.rest)[on].max() <= left_open
    assert np.abs(ended.anchor_force).max() <= tolerance
    for slot in slots.tolist():
        state.drop(slot)
    assert state.solve().converged
    left, rest = state.x[off].copy(), MESH.rest[on]
    assert np.array_equal(state.x[on], rest)
    # Its shape is its own again, fitted to where it was: no further from there than it was from its shape.
    assert np.abs(left - motion.apply(MESH.rest[off])).max() <= 2.0 * np.sqrt(3.0 * len(piece)) * left_open
    node = VESSEL.node(5, 3)
    other = grip(state, [node])
    for k in range(3 * LAG):
        tick(state, other, (MESH.rest[node] + np.array([0.0, 0.0, 0.01 * k]))[None])
        assert np.array_equal(state.x[off], left)
    assert np.abs(state.x - MESH.rest)[on].max() > 0.1
    again = grip(state, held)
    target = state.x[held] + np.array([0.0, 0.0, 0.1])
    assert state.solve(anchors(again, target), tolerance_mN=tolerance, max_iterations=300).converged
    assert np.abs(state.x[off] - left - [0.0, 0.0, 0.1]).max() <= left_open


def test_a_node_that_lost_all_its_links_stays_where_it_is_until_it_is_held() -> None:
    """Its row of the stiffness is zero: a factor made of what is left alone would be no number. Its neighbours move."""
    lonely, drawn = VESSEL.node(2, 3), VESSEL.node(2, 4)
    state = state_of(MESH)
    slots = grip(state, [drawn])
    place = MESH.rest[drawn] + [0.0, 0.05, 0.1]
    assert state.solve(anchors(slots, place[None]), max_iterations=100).converged
    state.cut(MESH.via[MESH.start[lonely] : MESH.start[lonely + 1]])
    at = state.x[lonely].copy()
    for k in range(3 * (LAG + LASTS)):
        tick(state, slots, (place + np.array([0.0, 0.0, 0.05 * np.sin(0.3 * k)]))[None])
        assert np.isfinite(state.x).all()
        assert np.array_equal(state.x[lonely], at)
    both = np.concatenate([slots, grip(state, [lonely])])
    target = np.stack([place, at + np.array([0.1, 0.0, 0.3])])
    for _ in range(3):
        assert state.solve(anchors(both, target), tolerance_mN=1e-6, max_iterations=100).converged
    assert np.abs(state.x[lonely] - target[1]).max() <= 1e-6 / JAWS * 2.0


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 200),
    together=st.booleans(),
    way=st.tuples(*[st.floats(-0.15, 0.15)] * 3),
)
def test_any_links_may_be_cut(seed: int, count: int, together: bool, way: tuple[float, float, float]) -> None:
    """Up to a fifth of the links, in one place or all over, while jaws hold a triangle of the wall.

    The factor of the whole mesh is stiffer than what is left, and positive definite: each step leads down. So the
    energy of what is left and what holds it never rises from solve to solve (1e-9 of it, and of 1 mN mm, for the
    rounding of a sum of a thousand terms), nothing flies (a link that bears and a spring of the jaws hold no more than
    that energy, so no node that they tie is further than √(2 E / k) from where it is tied to, per link; 1 mm is ten
    times what was found), and forces are measured with a mesh that never had the links. It is in equilibrium again
    within 5 LAG ticks of 8 iterations (15 were the most in 150 trials), and remains so over the next factors.
    """
    rng = np.random.default_rng(seed)
    nodes = [VESSEL.node(int(rng.integers(0, 7)), int(rng.integers(0, 12)))]
    nodes += [nodes[0] + 2 * VESSEL.spec.around, VESSEL.node(layer()[nodes[0]], nodes[0] % VESSEL.spec.around + 1)]
    middle = MESH.rest[MESH.links].mean(axis=1)
    near = np.argsort(np.linalg.norm(middle - MESH.rest[nodes[0]], axis=1))
    links = near[:count] if together else rng.choice(len(MESH.links), count, replace=False)
    state = state_of(MESH)
    slots = grip(state, nodes)
    places = MESH.rest[nodes] + np.array(way)
    for share in (0.5, 1.0, 1.0):
        tick(state, slots, MESH.rest[nodes] + share * np.array(way))
    state.cut(links)
    left, before, settled = without(links), np.inf, 0
    for _ in range(5 * LAG):
        ended = tick(state, slots, places)
        now = energy(left, state.x) + 0.5 * JAWS * float(np.sum((state.x[nodes] - places) ** 2))
        assert now <= before + 1e-9 * (1.0 + now)
        assert np.abs(state.x - MESH.rest).max() < 1.0
        before, settled = now, settled + 1 if ended.converged else 0
        if settled == 2 * LAG:
            break
    assert settled >= 2 * LAG
    unbalanced = forces(left, state.x)
    unbalanced[nodes] += JAWS * (places - state.x[nodes])
    assert np.linalg.norm(unbalanced[~MESH.fixed]) <= TICK_mN * (1.0 + 1e-6)


def test_nothing_of_a_cut_depends_on_how_fast_the_machine_is() -> None:
    """A second cut while the factor of the first is made: the same bits, whether the thread was done with it by then or
    had not begun."""

    def run(late_s: float, pause_s: float) -> Array:
        state = state_of(MESH)
        slots = grip(state, lip())
        for k in range(5 * LAG):
            if k == 5:
                state.compliance._thread.submit(sleep, late_s)
            if k in (5, 5 + LAG // 2):
                state.cut(slit(2 if k == 5 else 6))
            tick(state, slots, MESH.rest[lip()] + [0.0, 0.01 * k, 0.005 * k])
            sleep(pause_s)
        return state.x

    late = run(0.2, 0.0)  # first: the kernel may have to be compiled
    assert np.array_equal(run(0.0, 0.004), late)


def test_a_cut_body_is_factored_anew_at_once_and_once() -> None:
    """A new factor after LAG solves, although the last one is younger than LASTS, and none after it: few iterations."""
    state = state_of(MESH)
    slots = grip(state, lip())
    places = MESH.rest[lip()] + [0.0, 0.02, 0.05]
    for _ in range(LAG + 2):  # the factor that the first of them asked for is two solves old
        tick(state, slots, places)
    factor = state.compliance.factors[0]
    state.cut(slit(4))
    taken = []
    for k in range(4 * LAG):
        tick(state, slots, places)
        if state.compliance.factors[0] is not factor:
            factor = state.compliance.factors[0]
            taken.append(k + 1)
    assert taken == [LAG]


def test_a_cut_is_the_solver_s_and_the_mesh_that_it_was_given_is_whole() -> None:
    state, twin = state_of(MESH), state_of(MESH)
    state.cut(slit(4))
    assert MESH.stiffness.min() > 0.0
    assert twin.mesh.stiffness.min() > 0.0
    assert np.array_equal(np.flatnonzero(state.mesh.stiffness == 0.0), slit(4))
    assert state.solve().converged
    assert np.array_equal(state.x, MESH.rest)


@pytest.mark.parametrize("number", [-1, len(MESH.links)])
def test_a_number_that_is_no_link_s_is_refused(number: int) -> None:
    state = state_of(MESH)
    with pytest.raises(ValueError, match=f"counted from 0 to {len(MESH.links) - 1}, found"):
        state.cut(np.array([0, number]))
    assert state.mesh.stiffness[0] > 0.0


def test_a_piece_finds_its_own_shape_where_it_lies() -> None:
    """Rest shape, moved rigidly, comes back as it is; noise of a strained piece is not carried on: no link is strained.

    A single node and two stay where their middle is."""
    motion = Rigid(np.array([3.0, -1.0, 2.0]), quaternion_from_axis_angle([1.0, 1.0, 0.0], 2.0))
    rest = MESH.rest[:30]
    assert unstrained(rest, motion.apply(rest)) == pytest.approx(motion.apply(rest), abs=1e-12)
    noisy = motion.apply(rest) + np.random.default_rng(0).normal(0.0, 0.01, rest.shape)
    found = unstrained(rest, noisy)
    spans = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in (rest, found)]
    assert spans[1] == pytest.approx(spans[0], abs=1e-12)
    assert np.linalg.norm(found - noisy) <= np.linalg.norm(motion.apply(rest) - noisy)
    assert np.array_equal(unstrained(rest[:1], noisy[:1]), noisy[:1])
    assert unstrained(rest[:2], noisy[:2]).mean(axis=0) == pytest.approx(noisy[:2].mean(axis=0), abs=1e-12)
