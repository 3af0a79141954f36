"""Verification of a link's tension as a function of its elongation: each test states the law that it checks."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from trainer.geometry import Array
from trainer.mechanics.link_law import j_shaped, moduli_along, steepest_tangent, stiffened_along
from trainer.mechanics.link_tension import (
    Branch,
    LinkLaw,
    area,
    loading,
    potential,
    slip_at,
    stored_energy,
    tension_and_tangent,
)
from trainer.mechanics.links import LinkMesh, forces, link_mesh, settle

REAL = Path(__file__).parents[3] / "shared/data/tissue/stress_strain_ascending.csv"

#: k mN/mm, β 1/mm, t mm, h, κ = k exp(β t): the toe ends at 0.7 mm, its tangent grown e^2.1 = 8.2 times.
J = (2.0, 3.0, 0.7, 0.3, 2.0 * math.exp(2.1))

laws = st.builds(
    lambda k, growth, toe, loss: (k, growth, toe, loss, k * math.exp(growth * toe)),
    st.floats(0.1, 10.0),
    st.just(0.0) | st.floats(0.1, 10.0),
    st.floats(0.0, 0.5),
    st.just(0.0) | st.floats(0.01, 0.9),
)
elongations = st.floats(-1.0, 1.0)


def chain(nodes: int = 2, stiffness: float = 5.0) -> LinkMesh:
    """Nodes 2 mm apart along x."""
    rest = np.zeros((nodes, 3))
    rest[:, 0] = 2.0 * np.arange(nodes)
    links = np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1)
    return link_mesh(rest, links, np.full(nodes - 1, stiffness), np.zeros(nodes, dtype=bool))


def driven(path: Array, law: tuple[float, float, float, float, float]) -> tuple[Array, float]:
    """Tension at each elongation of ``path`` (p,), and the work done on the link on the way.

    Simpson's rule on each part of the path, the slip being that of the part's beginning.
    """
    slip, work, seen = 0.0, 0.0, []
    for a, b in pairwise(path):
        ta, tm, tb = (tension_and_tangent(e, slip, *law)[0] for e in (a, 0.5 * (a + b), b))
        work += (b - a) * (ta + 4.0 * tm + tb) / 6.0
        slip = slip_at(b, slip, *law)
        seen.append(tb)
    return np.array(seen), work


@given(law=laws, elongation=elongations, slip=elongations)
def test_the_tangent_is_the_tensions_derivative(law: tuple[float, ...], elongation: float, slip: float) -> None:
    """A difference quotient over ±d is a mean of the tangents there, so it lies within their spread of each of them.

    Where there is no kink the spread is a factor exp(2 β d) = 1 + 2e-4, at most; kinks (a friction limit is met, the
    toe ends) and a friction branch that is shorter than 3 d are left out. Rounding, 2e-16 T / d, is 1e-10 of κ.
    """
    d = 1e-5
    k, growth, toe, loss, friction = law
    assume(loss == 0.0 or elongation < -d or loss * loading(elongation, k, growth, toe)[0] > 3.0 * d * friction)
    tangents = [tension_and_tangent(elongation + s * d, slip, *law)[1] for s in (-1.0, 0.0, 1.0)]
    spread = max(tangents) - min(tangents)
    assume(spread <= 2.1e-4 * min(tangents))
    up, down = (tension_and_tangent(elongation + s * d, slip, *law)[0] for s in (1.0, -1.0))
    assert (up - down) / (2.0 * d) == pytest.approx(tangents[1], abs=spread + 1e-9 * friction)


@given(law=laws, elongation=elongations)
@example(law=(1.0, 1e-3, 0.5, 0.0, 1.0), elongation=1e-3)
def test_the_area_is_the_tensions_integral(law: tuple[float, ...], elongation: float) -> None:
    """Gauss's rule of 20 points is exact to rounding for exp(β Δ), β Δ <= 5, on each side of the end of the toe."""
    k, growth, toe, _, _ = law
    nodes, weights = np.polynomial.legendre.leggauss(20)
    whole = 0.0
    cuts = sorted({0.0, *(c for c in (toe, elongation) if 0.0 <= c <= elongation), elongation})
    for a, b in pairwise(cuts):
        at = 0.5 * (a + b) + 0.5 * (b - a) * nodes
        whole += 0.5 * (b - a) * sum(w * loading(e, k, growth, toe)[0] for e, w in zip(at, weights, strict=True))
    assert area(elongation, k, growth, toe) == pytest.approx(abs(whole), rel=1e-12, abs=1e-300)


@given(law=laws)
def test_loading_from_rest_follows_the_j_and_the_toe_ends_without_a_kink(law: tuple[float, ...]) -> None:
    """T = (k / β)(exp(β Δ) - 1), and its slope is continuous at the end of the toe: exp(β 1e-9) = 1 + 1e-8."""
    k, growth, toe, _, steepest = law
    within = 0.9 * toe
    curve = k * within if growth == 0.0 else k / growth * (math.exp(growth * within) - 1.0)
    assert tension_and_tangent(within, 0.0, *law)[0] == pytest.approx(curve, rel=1e-12, abs=1e-12)
    assert loading(toe + 1e-9, k, growth, toe)[1] == pytest.approx(steepest, rel=1e-12)
    assert loading(toe - 1e-9, k, growth, toe)[1] == pytest.approx(steepest, rel=2e-8)


def test_a_cycle_loses_what_the_docstring_says() -> None:
    """h U(Δ) - (h T(Δ))² / (2 κ), from rest to Δ and back.

    Simpson's rule errs by (β step)⁴ / 2880 of the work on smooth parts, 1e-15 at 4000 parts; on each of the few parts
    with a kink by at most (change of the slope) · step² / 8 <= 16 · 6e-8 / 8: 1e-6 of 5 mN mm in all.
    """
    k, growth, toe, loss, friction = J
    there = np.linspace(0.0, 1.0, 4001)
    _, work = driven(np.concatenate([there, there[-2::-1]]), J)
    top = loading(1.0, k, growth, toe)[0]
    expected = loss * area(1.0, k, growth, toe) - (loss * top) ** 2 / (2.0 * friction)
    assert expected > 0.5
    assert work == pytest.approx(expected, abs=1e-6)


def test_unloading_follows_the_lower_branch_and_reloading_finds_the_upper_one() -> None:
    k, growth, toe, loss, _ = J
    seen, _ = driven(np.array([0.0, 1.0, 0.6, 0.3, 1.0]), J)
    upper = [loading(e, k, growth, toe)[0] for e in (1.0, 0.6, 0.3, 1.0)]
    assert seen == pytest.approx([upper[0], (1.0 - loss) * upper[1], (1.0 - loss) * upper[2], upper[3]], rel=1e-13)


@given(law=laws, path=st.lists(elongations, min_size=1, max_size=6))
def test_no_path_gains_energy(law: tuple[float, ...], path: list[float]) -> None:
    """Work done on the link >= the energy that it stores, on any path from rest: what is lost, q dp, is not negative.

    The work is Simpson's on 400 parts of each stretch; its error, with kinks, is below 1e-4 of κ (1 mm)².
    """
    stretches = [np.linspace(a, b, 401)[1:] for a, b in zip([0.0, *path[:-1]], path, strict=True)]
    places = np.concatenate([[0.0], *stretches])
    _, work = driven(places, law)
    slip = 0.0
    for e in places[1:]:
        slip = slip_at(e, slip, *law)
    assert work >= stored_energy(path[-1], slip, *law) - 1e-4 * law[4]


@given(law=laws, path=st.lists(elongations, min_size=1, max_size=6))
def test_without_loss_the_work_is_stored(law: tuple[float, ...], path: list[float]) -> None:
    """No hysteresis, no memory: the work to any place is U there. Simpson on 400 parts, one kink at the toe's end."""
    elastic = (*law[:3], 0.0, law[4])
    stretches = [np.linspace(a, b, 401)[1:] for a, b in zip([0.0, *path[:-1]], path, strict=True)]
    _, work = driven(np.concatenate([[0.0], *stretches]), elastic)
    assert work == pytest.approx(stored_energy(path[-1], 0.0, *elastic), abs=1e-6 * law[4])


@given(law=laws, elongation=elongations, slip=elongations)
def test_no_tangent_is_steeper_than_the_steepest(law: tuple[float, ...], elongation: float, slip: float) -> None:
    """The explicit methods' stable step rests on it; rounding of exp(β Δ) is within 1e-14."""
    flat = LinkLaw(*(np.array([a]) for a in law))
    tension, tangent = tension_and_tangent(elongation, slip, *law)
    assert 0.0 < tangent <= steepest_tangent(flat)[0] * (1.0 + 1e-14)
    assert tension <= steepest_tangent(flat)[0] * max(elongation, 0.0) * (1.0 + 1e-14)


@given(law=laws, elongation=elongations, slip=elongations)
@example(law=J, elongation=0.69, slip=0.5)
def test_the_potential_is_the_tensions_integral(law: tuple[float, ...], elongation: float, slip: float) -> None:
    """The tension never falls: a difference quotient of its integral lies between its values at both ends, and the
    integral from 0 between its sums over the left and the right ends of 1000 parts.

    Rounding: 20 units in the last place of potentials of up to κ/2 are 2e-15 κ, and 2e-10 of κ over 2 d.
    """
    d = 1e-5
    up, down = (potential(elongation + s * d, slip, *law) for s in (1.0, -1.0))
    above, below = (tension_and_tangent(elongation + s * d, slip, *law)[0] for s in (1.0, -1.0))
    noise = 1e-9 * law[4]
    assert below - noise <= (up - down) / (2.0 * d) <= above + noise
    seen = np.array([tension_and_tangent(e, slip, *law)[0] for e in np.linspace(0.0, elongation, 1001)])
    least, most = sorted(elongation / 1000 * float(part.sum()) for part in (seen[:-1], seen[1:]))
    assert least - 1e-12 * law[4] <= potential(elongation, slip, *law) <= most + 1e-12 * law[4]


def test_each_link_has_its_own_law() -> None:
    """Per link: the growth is one of strain, so a link of 2 mm has half of it per mm; the slip settles link by link."""
    mesh = chain(3)
    law = j_shaped(mesh, growth=np.array([0.0, 8.0]), toe_strain=0.25, loss=np.array([0.0, 0.5]))
    mesh, x = replace(mesh, law=law), mesh.rest * np.array([1.2, 1.0, 1.0])
    first, second = 2.0, 5.0 / 4.0 * math.expm1(1.6)
    assert forces(mesh, x)[:, 0] == pytest.approx([first, second - first, -second], rel=1e-14)
    branch = Branch(law, np.zeros(2))
    settle(mesh, x, branch)
    assert branch.slip[0] == 0.0
    assert branch.slip[1] == pytest.approx(0.4 - 0.5 * second / (5.0 * math.exp(2.0)), rel=1e-14)
    assert forces(mesh, 0.5 * (x + mesh.rest), branch)[2, 0] == pytest.approx(-0.5 * 1.25 * math.expm1(0.8), rel=1e-14)


@pytest.mark.parametrize(
    ("given_", "said"),
    [
        ({"growth": -1.0, "toe_strain": 0.1}, "'growth'"),
        ({"growth": np.nan, "toe_strain": 0.1}, "'growth'"),
        ({"growth": 1.0, "toe_strain": np.inf}, "'toe_strain'"),
        ({"growth": 1e4, "toe_strain": 1.0}, "too large"),
        ({"growth": 1.0, "toe_strain": 0.1, "loss": 1.0}, "'loss'"),
    ],
)
def test_what_is_no_law_is_refused(given_: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        j_shaped(chain(), **given_)


@pytest.mark.skipif(not REAL.exists(), reason="the measured table is not part of the project")
def test_the_toe_is_that_of_a_ligament() -> None:
    """Cruciate ligaments at 10 %/min: (k, β) from 2 % and 4 % strain alone give the whole table, 0.25 % … 7.5 %.

    With equal steps of strain exp(2 % β) = T(4 %) / T(2 %) - 1. The table has three to six digits (its first value is
    1.50e-3): 5e-3 relative. Its smoothness shows that it was itself written from such a curve, so this checks that the
    law has the form that the authors chose, not that they chose well.
    """
    with REAL.open(encoding="utf-8") as file:
        rows = [
            (float(r["strain_percent"]) / 100.0, float(r["stress_MPa_10pct_per_min"])) for r in csv.DictReader(file)
        ]
    table = {strain: stress for strain, stress in rows if stress > 0.0}
    growth = math.log(table[0.04] / table[0.02] - 1.0) / 0.02
    k = table[0.02] * growth / math.expm1(0.02 * growth)
    assert len(table) > 25
    for strain, stress in table.items():
        assert loading(strain, k, growth, 0.08)[0] == pytest.approx(stress, rel=5e-3)


def even_directions(points: int) -> tuple[Array, Array]:
    """Unit vectors (d, 3) and weights (d,), Σ = 1, that average polynomials of degree 2 points - 1 exactly.

    Gauss's rule along the axis 1, and 2 points even angles around it.
    """
    z, w = np.polynomial.legendre.leggauss(points)
    angle = np.arange(2 * points) * (np.pi / points)
    ring = np.sqrt(1.0 - z * z)
    n = np.stack(np.broadcast_arrays(z[:, None], ring[:, None] * np.cos(angle), ring[:, None] * np.sin(angle)), axis=-1)
    return n.reshape(-1, 3), np.repeat(0.5 * w / (2 * points), 2 * points)


@pytest.mark.parametrize("ratio", [0.2, 1.0, 5.0])
def test_the_moduli_along_and_across_a_direction(ratio: float) -> None:
    """A star of links in all directions with Σ k L² = 6 E V is stiffened; its moduli are those of the formula.

    The polynomials have degree 6, the rule is exact to 9: what is left is rounding. The inverse is numpy's.
    """
    modulus, n_w = 500.0, even_directions(5)
    rest = np.concatenate([np.zeros((1, 3)), n_w[0]])
    links = np.stack([np.zeros(len(n_w[0]), dtype=np.int64), np.arange(1, len(rest))], axis=1)
    star = link_mesh(rest, links, 6.0 * modulus * n_w[1], np.zeros(len(rest), dtype=bool))
    k = stiffened_along(star, np.array([3.0, 0.0, 0.0]), ratio)
    c = np.einsum("e,ei,ej->ij", k, n_w[0] ** 2, n_w[0] ** 2)
    s = np.linalg.inv(c)
    assert moduli_along(modulus, ratio) == pytest.approx((1.0 / s[0, 0], 1.0 / s[1, 1]), rel=1e-12)
    if ratio == 1.0:
        assert moduli_along(modulus, ratio) == pytest.approx((modulus, modulus), rel=1e-12)


def test_a_link_along_the_direction_is_stiffer_by_the_ratio() -> None:
    mesh = chain()
    assert stiffened_along(mesh, np.array([1.0, 0.0, 0.0]), 3.0) == pytest.approx([15.0])
    assert stiffened_along(mesh, np.array([0.0, 1.0, 0.0]), 3.0) == pytest.approx([5.0])
    with pytest.raises(ValueError, match="ratio"):
        stiffened_along(mesh, np.array([1.0, 0.0, 0.0]), 0.0)
