"""Cholesky factor of a banded stiffness matrix, kept for many solves.

A matrix whose entries lie within b of the diagonal needs n b² multiplications to factor and 2 n b to solve
(Golub and Van Loan, Matrix Computations, section 4.3). The factor is kept by columns, and both substitutions take the
three columns of a node at once: forwards they subtract multiples of contiguous stretches, backwards they sum products.

The factor is kept in whole numbers of 16 bits, a unit for each column; a solve adds up in single precision. It is bound
by the memory that it reads, and this is half of what single precision reads: two vessels' factors then stay in the
cache of a core. A solve is right to about 1e-4 of its answer, and L D Lᵀ positive definite as ever: a base for
iterations that measure their own residual, not an answer. It is computed in double precision where it has to be told
whether the matrix is singular, and in single precision, which takes half as long, where that is known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array

#: A pivot below this share of the diagonal is lost in rounding: the matrix is singular, or not positive definite.
SINGULAR = 1e-9
#: Columns that the factorisation subtracts from a later one at once.
GROUP = 4
#: The substitutions' loops run over multiples of this many numbers, with none left over.
STRETCH = 32
#: The largest number in a column of a kept factor.
LARGEST = 32767.0


class BandedFactor(NamedTuple):
    """L and D of K = L D Lᵀ for the nodes ``order``; the unknown 3 p + c is component c of node ``order[p]``."""

    order: np.ndarray  # (f,) int32 nodes, in the order of elimination
    columns: np.ndarray  # (3 f, b) int16, L[j + 1 + k, j] in units of …
    unit: np.ndarray  # (3 f,) float32, of a column
    inverse: Array  # (3 f,) 1 / D[j]


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


@njit(cache=True, nogil=True, error_model="numpy")
def factor_band(
    band: np.ndarray,
    diagonal: Array,
    columns: np.ndarray,
    unit: np.ndarray,
    inverse: Array,
    least: float,
) -> int:
    """L D Lᵀ, L with unit diagonal, column by column from those before it (left-looking).

    ``band`` (3 f, b + 1 + GROUP) holds K as in :func:`assemble_band`, with zeros in its last columns, and is
    overwritten with D Lᵀ. ``columns[j, k]`` times ``unit[j]`` is L[j + 1 + k, j], ``inverse[j]`` is 1 / D[j]. A pivot
    that is below the share ``least`` of ``diagonal`` (3 f,), the band's own before, is replaced by it, so that the rest
    stays finite. Returns how often that was done: unless it is 0, the factor is that of another matrix.
    """
    n, b = columns.shape
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
        largest = 0.0
        for k in range(1, size):
            largest = max(largest, abs(band[j, k] * inverse[j]))
        unit[j] = largest / LARGEST
        if unit[j] == 0.0:
            unit[j] = 1.0
        for k in range(1, size):
            columns[j, k - 1] = round(band[j, k] * inverse[j] / unit[j])
    return replaced


@njit(cache=True, nogil=True, error_model="numpy")
def substitute_forwards(columns: np.ndarray, unit: np.ndarray, inverse: Array, v: np.ndarray) -> None:
    """Overwrites ``v`` (3 f,) float32 with D⁻¹ L⁻¹ v."""
    n, b = columns.shape
    for j in range(0, n, 3):
        a0 = v[j] * unit[j]
        v[j + 1] -= a0 * np.float32(columns[j, 0])
        a1 = v[j + 1] * unit[j + 1]
        v[j + 2] -= a0 * np.float32(columns[j, 1]) + a1 * np.float32(columns[j + 1, 0])
        a2 = v[j + 2] * unit[j + 2]
        below = n - 3 - j
        reach = min(b - 2, below)
        c0, c1, c2 = columns[j, 2 : 2 + reach], columns[j + 1, 1 : 1 + reach], columns[j + 2, :reach]
        target = v[j + 3 : j + 3 + reach]
        for k in range(reach):
            target[k] -= a0 * np.float32(c0[k]) + a1 * np.float32(c1[k]) + a2 * np.float32(c2[k])
        if reach < below:  # the second and third columns reach one and two rows further
            v[j + 3 + reach] -= a1 * np.float32(columns[j + 1, 1 + reach]) + a2 * np.float32(columns[j + 2, reach])
        if reach + 1 < below:
            v[j + 4 + reach] -= a2 * np.float32(columns[j + 2, 1 + reach])
    for j in range(n):
        v[j] *= inverse[j]


# The compiler may reorder these sums: they do not vectorise otherwise, and the factor would have to be
# kept by rows as well. The order is fixed when it is compiled, so results are still the same bits in every run.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc"})
def substitute_backwards(columns: np.ndarray, unit: np.ndarray, v: np.ndarray) -> None:
    """Overwrites ``v`` (3 f,) float32 with L⁻ᵀ v."""
    n, b = columns.shape
    for j in range(n - 3, -1, -3):
        below = n - 3 - j
        reach = min(b - 2, below)
        c0, c1, c2 = columns[j, 2 : 2 + reach], columns[j + 1, 1 : 1 + reach], columns[j + 2, :reach]
        known = v[j + 3 : j + 3 + reach]
        s0 = s1 = s2 = np.float32(0.0)
        for k in range(reach):
            s0 += np.float32(c0[k]) * known[k]
            s1 += np.float32(c1[k]) * known[k]
            s2 += np.float32(c2[k]) * known[k]
        if reach < below:
            s1 += np.float32(columns[j + 1, 1 + reach]) * v[j + 3 + reach]
            s2 += np.float32(columns[j + 2, reach]) * v[j + 3 + reach]
        if reach + 1 < below:
            s2 += np.float32(columns[j + 2, 1 + reach]) * v[j + 4 + reach]
        v[j + 2] -= unit[j + 2] * s2
        v[j + 1] -= unit[j + 1] * (s1 + np.float32(columns[j + 1, 0]) * v[j + 2])
        v[j] -= unit[j] * (s0 + np.float32(columns[j, 0]) * v[j + 1] + np.float32(columns[j, 1]) * v[j + 2])


@njit(cache=True, nogil=True, error_model="numpy")
def gather(values: Array, order: np.ndarray, v: np.ndarray) -> None:
    """``v`` (3 f,) takes the rows ``order`` of ``values`` (n, 3)."""
    for p in range(len(order)):
        node = np.uintp(order[p])  # see links.add_forces
        for c in range(3):
            v[3 * p + c] = values[node, c]


@njit(cache=True, nogil=True, error_model="numpy")
def scatter(v: np.ndarray, order: np.ndarray, values: Array) -> None:
    """The rows ``order`` of ``values`` (n, 3) take ``v`` (3 f,)."""
    for p in range(len(order)):
        node = np.uintp(order[p])
        for c in range(3):
            values[node, c] = v[3 * p + c]


@njit(cache=True, nogil=True, error_model="numpy")
def solve(kept: BandedFactor, values: Array, v: np.ndarray, out: Array) -> None:
    """K⁻¹ of the forces ``values`` (n, 3) mN on the factor's nodes into the same rows of ``out`` (n, 3) mm.

    Overwrites ``v``, at least (3 f,) float32.
    """
    u = v[: len(kept.inverse)]
    gather(values, kept.order, u)
    substitute_forwards(kept.columns, kept.unit, kept.inverse, u)
    substitute_backwards(kept.columns, kept.unit, u)
    scatter(u, kept.order, out)


class Band(NamedTuple):
    """Where a matrix of one topology is factored, again and again."""

    links: np.ndarray  # (m, 2) int32
    place: np.ndarray  # (n,) int32, a node's position in the order of elimination, or -1
    values: np.ndarray  # (3 f, b + 1 + GROUP) float32 or float64
    diagonal: Array  # (3 f,)


def room(links: np.ndarray, order: np.ndarray, node_count: int, number: type[np.floating]) -> tuple[Band, BandedFactor]:
    """For factors of a stiffness that the ``links`` (m, 2) add up to on the nodes ``order`` (f,), each computed
    in this kind of ``number``."""
    place = np.full(node_count, -1, dtype=np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    ends = place[links]
    ends = ends[np.all(ends >= 0, axis=1)]
    reach = int(np.max(np.abs(ends[:, 1] - ends[:, 0]), initial=0))
    size = 3 * len(order)
    b = STRETCH * -(-3 * reach // STRETCH) + 2
    # Written now: a page of memory that is touched for the first time costs time, milliseconds for these.
    band = Band(np.ascontiguousarray(links), place, np.full((size, b + 1 + GROUP), number(0.0)), np.zeros(size))
    columns = np.full((size, b), 0, dtype=np.int16)
    unit = np.full(size, 1.0, dtype=np.float32)
    return band, BandedFactor(np.ascontiguousarray(order, dtype=np.int32), columns, unit, np.zeros(size))


@njit(cache=True, nogil=True, error_model="numpy")
def factor_blocks(blocks: Array, band: Band, out: BandedFactor, least: float) -> int:
    """Overwrites ``out`` with the factor of the link blocks (m, 3, 3); returns how many pivots were too small, see
    :func:`factor_band`."""
    band.values[:] = 0.0
    assemble_band(blocks, band.links, band.place, band.values)
    band.diagonal[:] = band.values[:, 0]
    return factor_band(band.values, band.diagonal, out.columns, out.unit, out.inverse, least)


def factor(blocks: Array, links: np.ndarray, order: np.ndarray, node_count: int) -> BandedFactor:
    """The factor of the link blocks (m, 3, 3) on the nodes ``order``.

    Raises ValueError when the matrix is not positive definite, that is when the nodes can move without
    stretching a link.
    """
    band, out = room(links, order, node_count, np.float64)
    if factor_blocks(blocks, band, out, SINGULAR):
        raise ValueError("the links do not hold all free nodes in place: the stiffness matrix is singular")
    return out
