"""Cholesky factor of a banded stiffness matrix, kept for many solves.

A matrix whose entries lie within b of the diagonal needs n b² multiplications to factor and 2 n b to solve
(Golub and Van Loan, Matrix Computations, section 4.3). The factor is kept by columns, and both substitutions take the
six columns of two nodes at once: forwards they subtract multiples of contiguous stretches, backwards they sum products.

The factor is kept in whole numbers of 8 bits; a solve adds up in single precision. It is bound by the memory that it
reads, and this is a quarter of what single precision reads: two vessels' factors then stay in the cache of a core,
beside what else a tick needs. A solve is right to about a tenth of its answer, and L D Lᵀ positive definite as ever: a
base for iterations that measure their own residual, not an answer. It is computed in double precision where it has to
be told whether the matrix is singular, and in single precision, which takes half as long, where that is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array

#: A pivot below this share of the diagonal is lost in rounding: the matrix is singular, or not positive definite.
SINGULAR = 1e-9
#: Columns that the factorisation subtracts from a later one at once.
GROUP = 4
#: Columns that the substitutions take at once: those of two nodes.
BLOCK = 6
#: The substitutions' loops run over multiples of this many numbers, with none left over.
STRETCH = 32
#: The largest number of a kept factor.
LARGEST = 127.0


class BandedFactor(NamedTuple):
    """L and D of K = L D Lᵀ for the nodes ``order``; the unknown 3 p + c is component c of node ``order[p]``.

    By blocks of BLOCK columns: on the diagonal L has identities, D square matrices. For an odd node the last block is
    filled up with the identity.
    """

    order: np.ndarray  # (f,) int32 nodes, in the order of elimination
    below: np.ndarray  # (n, BLOCK, r) int8, by columns, the r rows of L below a block, in units of …
    unit: np.ndarray  # (n, BLOCK) float32, of a column, times …
    share: np.ndarray  # (r,) float32, of a row below its block
    inverse: np.ndarray  # (n, BLOCK, BLOCK) float32, D⁻¹


@njit(cache=True, nogil=True, error_model="numpy")
def assemble_band(blocks: Array, links: np.ndarray, place: np.ndarray, band: np.ndarray) -> None:
    """Adds the link blocks (m, 3, 3) to ``band`` (3 f, b + 1 or more), band[j, k] = K[j + k, j].

    ``place`` (n,) is a node's position in the order of elimination, or -1 for a node without unknowns.
    """
    for e in range(len(links)):
        p, q = place[links[e, 0]], place[links[e, 1]]
        for r in range(3):
            for c in range(3):
                if r >= c:
                    if p >= 0:
                        band[3 * p + c, r - c] += blocks[e, r, c]
                    if q >= 0:
                        band[3 * q + c, r - c] += blocks[e, r, c]
                if p >= 0 and q >= 0:
                    low, high = min(p, q), max(p, q)
                    band[3 * low + c, 3 * (high - low) + r - c] -= blocks[e, r, c]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def factor_band(band: np.ndarray, diagonal: Array, inverse: Array, least: float) -> int:
    """L D Lᵀ, L with unit diagonal, column by column from those before it (left-looking).

    ``band`` (3 f, b + 1 + GROUP) holds K as in :func:`assemble_band`, with zeros in its last columns, and is
    overwritten with D Lᵀ; ``inverse[j]`` is 1 / D[j]. A pivot that is below the share ``least`` of ``diagonal`` (3 f,),
    the band's own before, is replaced by it, so that the rest stays finite. Returns how often that was done: unless it
    is 0, the factor is that of another matrix.
    """
    n, b = len(band), band.shape[1] - 1 - GROUP
    number = band.dtype.type
    replaced = 0
    for j in range(n):
        size = min(b, n - 1 - j) + 1
        i = max(0, j - b)
        while i + GROUP <= j:  # written out below for a GROUP of four
            # The last of them reaches furthest down; the others meet the band's zeros there.
            reach = min(size, i + 3 + b - j + 1)
            m0, m1 = number(band[i, j - i] * inverse[i]), number(band[i + 1, j - i - 1] * inverse[i + 1])
            m2, m3 = number(band[i + 2, j - i - 2] * inverse[i + 2]), number(band[i + 3, j - i - 3] * inverse[i + 3])
            s0, s1 = band[i, j - i : j - i + reach], band[i + 1, j - i - 1 : j - i - 1 + reach]
            s2, s3 = band[i + 2, j - i - 2 : j - i - 2 + reach], band[i + 3, j - i - 3 : j - i - 3 + reach]
            target = band[j, :reach]
            for k in range(reach):
                target[k] -= m0 * s0[k] + m1 * s1[k] + m2 * s2[k] + m3 * s3[k]
            i += GROUP
        while i < j:
            reach = min(size, i + b - j + 1)
            multiplier = number(band[i, j - i] * inverse[i])
            source = band[i, j - i : j - i + reach]
            target = band[j, :reach]
            for k in range(reach):
                target[k] -= multiplier * source[k]
            i += 1
        pivot = band[j, 0]
        if not pivot > least * diagonal[j]:
            pivot = diagonal[j]
            replaced += 1
        inverse[j] = 1.0 / pivot
    return replaced


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def join_columns(band: np.ndarray, inverse: Array, kept: BandedFactor) -> None:
    """From single columns to blocks of them: with the triangle C of a block's own columns and their D, C D Cᵀ is the
    block of D on the diagonal, and what is below is multiplied by C⁻¹.

    ``band`` has D Lᵀ, and is left with the rows below a block from ``band[j, BLOCK - j % BLOCK]`` on.
    """
    r = len(kept.share)
    for j in range(len(band)):
        band[j] *= inverse[j]
    for p in range(len(kept.below)):
        first = BLOCK * p
        size = min(BLOCK, len(band) - first)
        for m in range(size - 2, -1, -1):
            for other in range(m + 1, size):
                multiplier = band[first + m, other - m]
                source = band[first + other, BLOCK - other : BLOCK - other + r]
                target = band[first + m, BLOCK - m : BLOCK - m + r]
                for k in range(r):
                    target[k] -= multiplier * source[k]
        for e in range(BLOCK):  # the block's inverse, (C D Cᵀ)⁻¹, by its columns
            x = kept.inverse[p, e]
            x[:] = 0.0
            x[e] = 1.0
            for m in range(size):
                for other in range(m + 1, size):
                    x[other] -= band[first + m, other - m] * x[m]
            for m in range(size):
                x[m] *= inverse[first + m]
            for m in range(size - 2, -1, -1):
                for other in range(m + 1, size):
                    x[m] -= band[first + m, other - m] * x[other]


@njit(cache=True, nogil=True, error_model="numpy")
def round_number(rows: np.ndarray, k: int, to_whole: float, lost: float, whole: np.ndarray) -> float:
    """One of a column's ``rows``, and what was ``lost`` above it, to a ``whole`` number; returns what is lost now."""
    exact = to_whole * rows[k] + lost
    rounded = min(max(np.rint(exact), -LARGEST), LARGEST) if rows[k] != 0.0 else 0.0
    whole[k] = rounded
    return float(exact - rounded)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"nnan", "nsz"})
def round_columns(band: np.ndarray, per: Array, kept: BandedFactor) -> None:
    """What :func:`join_columns` left in ``band`` to 8 bits, into ``kept``. Overwrites ``band`` and ``per`` (r,).

    Numbers in the middle of a column are small, because its own ring of nodes and the next are at its ends: the rows'
    shares even out what all columns have in common. What rounding takes from a number is added to the same component
    of the next node. Their sum is then right, and so are forces on displacements that are nearly one for nodes nearby:
    to those the matrix is softest, and errors count most.
    """
    share, r = kept.share, len(kept.share)
    share[:] = np.float32(1e-12)
    for j in range(len(band)):
        rows = band[j, BLOCK - j % BLOCK : BLOCK - j % BLOCK + r]
        for k in range(r):
            share[k] += rows[k] * rows[k]
    for k in range(r):
        share[k] = math.sqrt(math.sqrt(share[k]))
        per[k] = 1.0 / share[k]
    for j in range(len(band)):
        p, m = j // BLOCK, j % BLOCK
        rows, whole = band[j, BLOCK - m : BLOCK - m + r], kept.below[p, m]
        largest = 1e-30
        for k in range(r):
            rows[k] *= per[k]
            largest = max(largest, abs(rows[k]))
        kept.unit[p, m] = largest / LARGEST
        to_whole = LARGEST / largest
        lost0 = lost1 = lost2 = 0.0
        for k in range(0, r - 2, 3):
            lost0 = round_number(rows, k, to_whole, lost0 * per[k], whole) / per[k]
            lost1 = round_number(rows, k + 1, to_whole, lost1 * per[k + 1], whole) / per[k + 1]
            lost2 = round_number(rows, k + 2, to_whole, lost2 * per[k + 2], whole) / per[k + 2]


# The compiler may contract a product and a sum to one operation, which leaves out a rounding …
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def substitute_forwards(kept: BandedFactor, v: np.ndarray) -> None:
    """Overwrites ``v`` (BLOCK n + r,) float32 with L⁻¹ v; its last r are zero, and stay so."""
    share = kept.share
    r = len(share)
    for p in range(len(kept.below)):
        c, unit = kept.below[p], kept.unit[p]
        own, target = v[BLOCK * p : BLOCK * p + BLOCK], v[BLOCK * p + BLOCK : BLOCK * p + BLOCK + r]
        a0, a1, a2 = own[0] * unit[0], own[1] * unit[1], own[2] * unit[2]
        a3, a4, a5 = own[3] * unit[3], own[4] * unit[4], own[5] * unit[5]
        c0, c1, c2, c3, c4, c5 = c[0], c[1], c[2], c[3], c[4], c[5]
        for k in range(r):
            target[k] -= share[k] * (
                a0 * np.float32(c0[k])
                + a1 * np.float32(c1[k])
                + a2 * np.float32(c2[k])
                + a3 * np.float32(c3[k])
                + a4 * np.float32(c4[k])
                + a5 * np.float32(c5[k])
            )


# … and reorder these sums: they do not vectorise otherwise, and the factor would have to be kept by rows as well. What
# it makes of it is fixed when it is compiled, so results are still the same bits in every run.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def substitute_backwards(kept: BandedFactor, v: np.ndarray) -> None:
    """Overwrites ``v`` (BLOCK n + r,) float32 with L⁻ᵀ D⁻¹ v; its last r are zero, and stay so."""
    share = kept.share
    r = len(share)
    for p in range(len(kept.below) - 1, -1, -1):
        c, unit, inverse = kept.below[p], kept.unit[p], kept.inverse[p]
        own, known = v[BLOCK * p : BLOCK * p + BLOCK], v[BLOCK * p + BLOCK : BLOCK * p + BLOCK + r]
        c0, c1, c2, c3, c4, c5 = c[0], c[1], c[2], c[3], c[4], c[5]
        s0 = s1 = s2 = s3 = s4 = s5 = np.float32(0.0)
        for k in range(r):
            x = share[k] * known[k]
            s0 += np.float32(c0[k]) * x
            s1 += np.float32(c1[k]) * x
            s2 += np.float32(c2[k]) * x
            s3 += np.float32(c3[k]) * x
            s4 += np.float32(c4[k]) * x
            s5 += np.float32(c5[k]) * x
        o0, o1, o2, o3, o4, o5 = own[0], own[1], own[2], own[3], own[4], own[5]
        for m in range(BLOCK):
            i = inverse[m]
            own[m] = i[0] * o0 + i[1] * o1 + i[2] * o2 + i[3] * o3 + i[4] * o4 + i[5] * o5
        own[0] -= unit[0] * s0
        own[1] -= unit[1] * s1
        own[2] -= unit[2] * s2
        own[3] -= unit[3] * s3
        own[4] -= unit[4] * s4
        own[5] -= unit[5] * s5


@njit(cache=True, nogil=True, error_model="numpy")
def gather(values: Array, order: np.ndarray, v: np.ndarray) -> None:
    """``v`` (3 f,) takes the rows ``order`` of ``values`` (n, 3)."""
    for p in range(len(order)):
        node = np.uintp(order[p])  # see links.add_forces
        for c in range(3):
            v[3 * p + c] = values[node, c]


@njit(cache=True, nogil=True, error_model="numpy")
def scatter(v: np.ndarray, order: np.ndarray, values: np.ndarray) -> None:
    """The rows ``order`` of ``values`` (n, 3) take ``v`` (3 f,)."""
    for p in range(len(order)):
        node = np.uintp(order[p])
        for c in range(3):
            values[node, c] = v[3 * p + c]


@njit(cache=True, nogil=True, error_model="numpy")
def solve(kept: BandedFactor, values: Array, v: np.ndarray, out: np.ndarray) -> None:
    """K⁻¹ of the forces ``values`` (n, 3) mN on the factor's nodes into the same rows of ``out`` (n, 3) mm.

    Overwrites ``v`` float32, at least as long as :func:`scratch` makes it.
    """
    unknowns = 3 * len(kept.order)
    u = v[: BLOCK * len(kept.below) + len(kept.share)]
    gather(values, kept.order, u)
    u[unknowns:] = np.float32(0.0)
    substitute_forwards(kept, u)
    substitute_backwards(kept, u)
    scatter(u, kept.order, out)


def scratch(factors: list[BandedFactor]) -> np.ndarray:
    """What :func:`solve` overwrites, for any of the ``factors``."""
    return np.full(max(BLOCK * len(kept.below) + len(kept.share) for kept in factors), np.float32(0.0))


class Band(NamedTuple):
    """Where a matrix of one topology is factored, again and again."""

    links: np.ndarray  # (m, 2) int32
    place: np.ndarray  # (n,) int32, a node's position in the order of elimination, or -1
    values: np.ndarray  # (3 f, b + 1 + GROUP) float32 or float64
    diagonal: Array  # (3 f,)
    inverse: Array  # (3 f,)
    per_share: Array  # (r,), see BandedFactor


def room(links: np.ndarray, order: np.ndarray, node_count: int, number: type[np.floating]) -> tuple[Band, BandedFactor]:
    """For factors of a stiffness that the ``links`` (m, 2) add up to on the nodes ``order`` (f,), each computed
    in this kind of ``number``."""
    place = np.full(node_count, -1, dtype=np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    ends = place[links]
    ends = ends[np.all(ends >= 0, axis=1)]
    reach = int(np.max(np.abs(ends[:, 1] - ends[:, 0]), initial=0))
    size, n = 3 * len(order), -(-3 * len(order) // BLOCK)
    r = STRETCH * -(-3 * reach // STRETCH)
    b = r + 2  # the first row of a node has two more of its own
    # Written now: a page of memory that is touched for the first time costs time, milliseconds for these.
    values = np.full((size, b + 1 + GROUP), number(0.0))
    band = Band(np.ascontiguousarray(links), place, values, np.zeros(size), np.zeros(size), np.zeros(r))
    below = np.full((n, BLOCK, r), np.int8(0))
    unit, share = np.full((n, BLOCK), np.float32(1.0)), np.full(r, np.float32(1.0))
    inverse = np.full((n, BLOCK, BLOCK), np.float32(0.0))
    return band, BandedFactor(np.ascontiguousarray(order, dtype=np.int32), below, unit, share, inverse)


@njit(cache=True, nogil=True, error_model="numpy")
def factor_blocks(blocks: Array, band: Band, out: BandedFactor, least: float) -> int:
    """Overwrites ``out`` with the factor of the link blocks (m, 3, 3); returns how many pivots were too small, see
    :func:`factor_band`."""
    band.values[:] = 0.0
    assemble_band(blocks, band.links, band.place, band.values)
    band.diagonal[:] = band.values[:, 0]
    replaced = factor_band(band.values, band.diagonal, band.inverse, least)
    join_columns(band.values, band.inverse, out)
    round_columns(band.values, band.per_share, out)
    return replaced


def factor(blocks: Array, links: np.ndarray, order: np.ndarray, node_count: int) -> BandedFactor:
    """The factor of the link blocks (m, 3, 3) on the nodes ``order``.

    Raises ValueError when the matrix is not positive definite, that is when the nodes can move without
    stretching a link.
    """
    band, out = room(links, order, node_count, np.float64)
    if factor_blocks(blocks, band, out, SINGULAR):
        raise ValueError("the links do not hold all free nodes in place: the stiffness matrix is singular")
    return out
