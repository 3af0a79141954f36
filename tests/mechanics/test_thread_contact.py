"""Contact of the rod with jaws, triangles and itself: nothing passes, friction is Coulomb's, lengths hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from round_jaws import touch_capsules

from trainer.geometry import Array
from trainer.mechanics.thread_contact import ContactsFull, clear, touch_itself, touch_triangles
from trainer.mechanics.thread_rod import RodModel, RodState, begin, holds, no_contacts, step

RADIUS = 0.011
TICK = 1e-3


def length_error(model: RodModel, state: RodState) -> float:
    """Of the links, beyond what their tension stretches them."""
    length = np.linalg.norm(np.diff(state.x, axis=0), axis=1)
    return float(np.max(np.abs(length / model.link - 1.0 - state.tension[1:] / model.axial)))


def all_pairs(links: int, others: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(links), np.arange(others), indexing="ij"), -1).reshape(-1, 2).astype(np.int32)


def around_a_jaw(links: int, tail: int, jaw: float) -> tuple[RodModel, Array]:
    """A thread over half of a round jaw, both ends straight down; ``links`` of it touch, in their middles."""
    ring = (jaw + RADIUS) / np.cos(np.pi / links / 2)
    angle = np.pi - np.arange(links + 1) * np.pi / links
    arc = np.stack([ring * np.cos(angle), 0 * angle, ring * np.sin(angle)], axis=1)
    link = float(np.linalg.norm(arc[1] - arc[0]))
    down = np.outer(np.arange(1, tail + 1), [0.0, 0.0, -link])
    x = np.concatenate([(arc[0] + down)[::-1], arc, arc[-1] + down])
    return RodModel(len(x), link, 4.3e-10, 0.0, 1e4, 5.4e-8), x


@pytest.mark.parametrize("friction", [0.0, 0.2, 0.4])
def test_tension_over_a_jaw_is_the_capstans(friction: float) -> None:
    """Euler and Eytelwein: dT = mu N, N = T dphi, so T2 / T1 = exp(mu phi), here phi = pi.

    On a chain whose links turn by e = pi / 40 the law is ((1 + mu tan(e / 2)) / (1 - mu tan(e / 2)))^40, within 1e-4
    of it; a normal that lags by a tenth of a link tilts a push by e / 10 and adds exp(pi e / 10) = 2 %: within 2 %.
    """
    model, x = around_a_jaw(40, 12, 2.0)
    state = begin(model, x)
    state.load[-1, 2] -= 1.0
    held = holds(model, [0], x[:1])
    contacts = no_contacts(100)
    axis, pairs = np.array([[0.0, -5.0, 0.0], [0.0, 5.0, 0.0]]), all_pairs(model.count - 1, 1)
    ratios = []
    for _ in range(25):
        held.target[0, 2] -= 0.2 * model.link
        clear(contacts)
        ahead = state.x + TICK * state.v
        touch_capsules(contacts, state.x, ahead, RADIUS, axis, axis, np.array([2.0]), pairs, friction, 0.1)
        step(state, held, TICK, 0.0, contacts)
        ratios.append(state.tension[1] / state.tension[-1])
        assert length_error(model, state) <= 1e-6
    assert ratios[5:] == pytest.approx(np.full(20, np.exp(friction * np.pi)), rel=0.02)


def test_a_thread_sticks_on_a_jaw_below_the_capstans_ratio() -> None:
    """Loads of 1 and 1.5 mN on its ends, mu = 0.3: 1.5 < exp(0.3 pi) = 2.57, so that it stays; 4 mN pull it round."""
    model, x = around_a_jaw(40, 12, 2.0)
    axis, pairs = np.array([[0.0, -5.0, 0.0], [0.0, 5.0, 0.0]]), all_pairs(model.count - 1, 1)
    went = []
    for load in (1.5, 4.0):
        state = begin(model, x)
        state.load[[0, -1], 2] -= [load, 1.0]
        contacts = no_contacts(100)
        nothing = holds(model, [], np.zeros((0, 3)))
        for _ in range(20):
            clear(contacts)
            touch_capsules(contacts, state.x, state.x, RADIUS, axis, axis, np.array([2.0]), pairs, 0.3, 0.3)
            step(state, nothing, 1e-6, 0.0, contacts)
        went.append(float(np.max(np.abs(state.x - x))))
    assert went[0] < 0.01
    assert went[1] > 10.0 * went[0]


def falling(links: int = 40, length: float = 20.0) -> tuple[RodModel, Array]:
    model = RodModel(links + 1, length / links, 4.3e-10, 0.01, 1e5, 5e-8)
    x = np.zeros((model.count, 3))
    x[:, 0] = np.arange(model.count) * model.link - 0.5 * length
    return model, x


@pytest.mark.parametrize("speed", [10.0, 1000.0, 10000.0])
def test_a_moving_jaw_never_passes_through(speed: float) -> None:
    """A jaw of 0.2 mm sweeps up at up to 50 radii a tick; the thread stays above its axis and out of it.

    One point of a link touches; a chord of d = 0.5 mm between two such points comes nearer to the axis than R + r =
    0.211 mm by up to d² / 8 R = 0.156 mm: 0.05 mm are left.
    """
    model, x = falling()
    state = begin(model, x + np.array([0.0, 0.0, 0.35]))
    contacts, nothing = no_contacts(100), holds(model, [], np.zeros((0, 3)))
    pairs = all_pairs(model.count - 1, 1)
    axis = np.array([[0.05, -3.0, 0.0], [0.05, 3.0, 0.0]])
    for _ in range(10):
        after = axis + np.array([0.0, 0.0, speed * TICK])
        clear(contacts)
        touch_capsules(contacts, state.x, state.x + TICK * state.v, RADIUS, axis, after, np.array([0.2]), pairs, 0.2,
                       2.0 * speed * TICK + 0.5)  # fmt: skip
        step(state, nothing, TICK, 0.0, contacts)
        axis = after
        assert state.x[20, 2] > axis[0, 2] + 0.05
        assert length_error(model, state) <= 1e-6


def test_a_thread_that_falls_on_a_floor_lies_on_it() -> None:
    """Two triangles as a floor: the nodes come to rest a radius above it, and the pushes bear the weight."""
    model, x = falling()
    state = begin(model, x + np.array([0.0, 0.0, 0.3]))
    vertices = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    contacts, nothing = no_contacts(400), holds(model, [], np.zeros((0, 3)))
    pairs = all_pairs(model.count - 1, 2)
    for _ in range(60):
        clear(contacts)
        touch_triangles(contacts, state.x, RADIUS, vertices, vertices, triangles, pairs, 0.3, 1.0)
        step(state, nothing, 2e-3, 0.0, contacts)
        assert state.x[:, 2].min() >= RADIUS - 0.01 * model.link
        assert length_error(model, state) <= 1e-6
    assert state.x[:, 2].max() <= RADIUS + 0.01
    used = contacts.used[0]
    assert contacts.push[:used].sum() == pytest.approx(model.mass * 9810.0 * model.length, rel=0.05)


@pytest.mark.parametrize("slope_deg", [10.0, 25.0])
def test_a_thread_on_a_slope_slides_above_the_angle_of_friction(slope_deg: float) -> None:
    """mu = 0.3 = tan(16.7°). Below it stays; above it goes at g (sin a - mu cos a), slower only by the air's m / c."""
    model, x = falling(10, 5.0)
    slope = np.radians(slope_deg)
    gravity = (0.0, 9810.0 * np.sin(slope), -9810.0 * np.cos(slope))
    model = RodModel(model.count, model.link, model.mass, model.bending, model.axial, 0.0, gravity)
    state = begin(model, x + np.array([0.0, 0.0, RADIUS]))
    vertices = np.array([[-50.0, -50, 0], [50, -50, 0], [0, 70, 0]])
    contacts, nothing = no_contacts(100), holds(model, [], np.zeros((0, 3)))
    for _ in range(50):
        clear(contacts)
        touch_triangles(contacts, state.x, RADIUS, vertices, vertices, np.array([[0, 1, 2]], dtype=np.int32),
                        all_pairs(10, 1), 0.3, 0.5)  # fmt: skip
        step(state, nothing, TICK, 0.0, contacts)
    expected = max(0.0, 9810.0 * (np.sin(slope) - 0.3 * np.cos(slope))) * 0.05
    assert state.v[:, 1] == pytest.approx(np.full(11, expected), rel=0.02, abs=0.2)


def test_a_thread_does_not_pass_through_itself() -> None:
    """One arm of a hairpin is thrown at the other: the links' distance stays two radii, to 10 % of them."""
    links, radius = 60, 0.05
    link = 0.3
    model = RodModel(links + 1, link, 4.3e-10, 0.001, 1e5, 5e-8, (0.0, 0.0, 0.0))
    angle = np.concatenate([np.zeros(20), np.linspace(0.0, np.pi * 1.2, 20), np.full(20, np.pi * 1.2)])
    t = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    x = np.concatenate([[[0.0, 0, 0]], np.cumsum(link * t, axis=0)])
    x[:, 2] = np.linspace(0.0, 1.0, links + 1) ** 2 * 3.0
    speed = np.zeros_like(x)
    speed[40:, 2] = -500.0
    state = begin(model, x, speed)
    held = holds(model, [0, 1, 2], state.x[:3])
    contacts = no_contacts(2000)
    i, j = np.triu_indices(links, 3)
    pairs = np.stack([i, j], axis=1).astype(np.int32)
    above = []
    for _ in range(30):
        clear(contacts)
        touch_itself(contacts, state.x, radius, pairs, 0.2, 1.5)
        step(state, held, TICK, 0.0, contacts)
        assert length_error(model, state) <= 1e-6
        above.append(float(state.x[45:, 2].min()))
    used = contacts.used[0]
    assert np.isfinite(state.x).all()
    clear(contacts)
    touch_itself(contacts, state.x, radius, pairs, 0.2, -0.1 * 2.0 * radius)
    assert contacts.used[0] == 0, "no two links are nearer than 0.9 of two radii"
    assert used > 0


def test_more_contacts_than_room_is_said() -> None:
    _, x = falling()
    axis = np.array([[0.0, -3.0, 0.0], [0.0, 3.0, 0.0]])
    with pytest.raises(ContactsFull, match="more room"):
        touch_capsules(no_contacts(1), x, x, RADIUS, axis, axis, np.array([0.2]), all_pairs(40, 1), 0.2, 5.0)


def roof(turn: float) -> tuple[Array, np.ndarray]:
    """Two triangles that meet along y at the origin, each going down by ``turn`` to its side."""
    side = np.array([math.cos(turn), 0.0, -math.sin(turn)])
    x = np.array([[0.0, -5, 0], [0, 5, 0], 5.0 * side, 5.0 * side * [-1, 1, 1]])
    return x, np.array([[0, 2, 1], [0, 1, 3]], dtype=np.int32)


@pytest.mark.parametrize("turn", [0.1, 0.5, 1.2])
def test_a_link_round_an_edge_stays_outside_of_both_sides(turn: float) -> None:
    """Half of it is behind the one side's plane and half behind the other's, and it is through neither: all push up.

    A link that goes through a side is pushed back to where its middle is, up or down.
    """
    surface, triangles = roof(turn)
    pairs = all_pairs(2, 2)
    across = np.array([[-0.1, 0.0, 0.02], [0.02, 0.0, 0.02], [0.12, 0.0, 0.02]])
    contacts = no_contacts(100)
    touch_triangles(contacts, across, RADIUS, surface, surface, triangles, pairs, 0.0, 0.5)
    used = int(contacts.used[0])
    assert used >= 4
    assert (contacts.normal[:used, 2] > 0.0).all()
    for height, way in ((0.03, 1.0), (-0.03, -1.0)):
        middle = np.array([1.0, 0.0, -math.tan(turn) + height])
        through = middle + np.outer([-1.0, 1.0, 3.0], [0.0, 0.0, 0.05])
        clear(contacts)
        touch_triangles(contacts, through, RADIUS, surface, surface, triangles[:1], all_pairs(1, 1), 0.0, 0.5)
        used = int(contacts.used[0])
        assert used > 0
        assert (np.sign(contacts.normal[:used, 2]) == way).all()


def test_a_thread_that_falls_across_a_ridge_hangs_over_it() -> None:
    """No node's skin is deeper in a side than a hundredth of its radius, since contacts are found once a tick."""
    surface, triangles = roof(0.6)
    count = 41
    x = np.stack([np.linspace(-1.0, 1.0, count), 0.01 * np.arange(count), np.full(count, 0.05)], axis=1)
    model = RodModel(count, float(np.linalg.norm(x[1] - x[0])), 5.6e-10, 1e-6, 1e3, 5.9e-8)
    state, nothing, contacts = begin(model, x), holds(model, [], np.zeros((0, 3))), no_contacts(1000)
    pairs = all_pairs(count - 1, 2)
    for _ in range(60):
        clear(contacts)
        touch_triangles(contacts, state.x, RADIUS, surface, surface, triangles, pairs, 0.3, 0.2)
        step(state, nothing, TICK, 0.0, contacts)
        assert length_error(model, state) <= 1e-6
        below = np.abs(state.x[:, 0]) * math.tan(0.6) + state.x[:, 2]
        assert below.min() * math.cos(0.6) >= 0.99 * RADIUS * math.cos(0.6)
    assert state.x[:, 2].min() < -0.2, "it did not hang over"
