"""A hierarchy of bounding spheres over triangles or segments, refitted when they deform.

Quinlan 1994, "Efficient distance computation between non-convex objects", section 2: a binary tree of spheres, made
once by dividing the elements along the longest side of their box; a node's sphere holds its two children's. Brown et
al. 2001, section 2.3, keep the tree when tissue deforms and only fit the spheres anew, from the leaves to the root.
Two trees are compared from their roots down: where two spheres are apart, nothing below them is looked at.

The tree is complete and kept as a heap: the children of node i are 2 i + 1 and 2 i + 2, the leaves are the last m
nodes, so that refitting is one backward pass over an array.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.closest_points import segment_near_triangle
from trainer.mechanics.pair_list import PairList, checked_elements, checked_margin, largest_magnitude, rounding_mm


@njit(cache=True, nogil=True, error_model="numpy")
def _refit(x, elements, leaf_element, spheres):  # type: ignore[no-untyped-def]
    m = leaf_element.shape[0]
    for leaf in range(m):
        e = leaf_element[leaf]
        a, b, c = elements[e, 0], elements[e, 1], elements[e, 2]
        if b == c:  # a segment
            cx, cy, cz = 0.5 * (x[a, 0] + x[b, 0]), 0.5 * (x[a, 1] + x[b, 1]), 0.5 * (x[a, 2] + x[b, 2])
        else:
            cx = (x[a, 0] + x[b, 0] + x[c, 0]) / 3.0
            cy = (x[a, 1] + x[b, 1] + x[c, 1]) / 3.0
            cz = (x[a, 2] + x[b, 2] + x[c, 2]) / 3.0
        da = (x[a, 0] - cx) ** 2 + (x[a, 1] - cy) ** 2 + (x[a, 2] - cz) ** 2
        db = (x[b, 0] - cx) ** 2 + (x[b, 1] - cy) ** 2 + (x[b, 2] - cz) ** 2
        dc = (x[c, 0] - cx) ** 2 + (x[c, 1] - cy) ** 2 + (x[c, 2] - cz) ** 2
        node = m - 1 + leaf
        spheres[node, 0], spheres[node, 1], spheres[node, 2] = cx, cy, cz
        spheres[node, 3] = math.sqrt(max(max(da, db), dc))
    for back in range(m - 1):
        node = m - 2 - back
        i, j = 2 * node + 1, 2 * node + 2
        dx = spheres[j, 0] - spheres[i, 0]
        dy = spheres[j, 1] - spheres[i, 1]
        dz = spheres[j, 2] - spheres[i, 2]
        ri, rj = spheres[i, 3], spheres[j, 3]
        apart = math.sqrt(dx * dx + dy * dy + dz * dz)
        radius = 0.5 * (apart + ri + rj)
        if radius <= ri:  # the second lies inside the first
            share, radius = 0.0, ri
        elif radius <= rj:
            share, radius = 1.0, rj
        else:
            share = (radius - ri) / apart
        spheres[node, 0] = spheres[i, 0] + share * dx
        spheres[node, 1] = spheres[i, 1] + share * dy
        spheres[node, 2] = spheres[i, 2] + share * dz
        spheres[node, 3] = radius


@njit(cache=True, nogil=True, error_model="numpy")
def _compare(  # type: ignore[no-untyped-def]
    p, segments, leaf_segment, first, x, triangles, leaf_triangle, second, margin, slack, stack, keys
):
    count = 0
    m, n = leaf_segment.shape[0], leaf_triangle.shape[0]
    stack[0, 0], stack[0, 1] = 0, 0
    top = 1
    while top > 0:
        top -= 1
        i, j = stack[top, 0], stack[top, 1]
        dx, dy, dz = first[i, 0] - second[j, 0], first[i, 1] - second[j, 1], first[i, 2] - second[j, 2]
        reach = first[i, 3] + second[j, 3] + margin + slack
        if dx * dx + dy * dy + dz * dz > reach * reach:
            continue
        i_is_leaf, j_is_leaf = i >= m - 1, j >= n - 1
        if i_is_leaf and j_is_leaf:
            s, f = leaf_segment[i - (m - 1)], leaf_triangle[j - (n - 1)]
            if segment_near_triangle(
                p, segments[s, 0], segments[s, 1], x, triangles[f, 0], triangles[f, 1], triangles[f, 2], margin
            ):
                if count < keys.shape[0]:
                    keys[count] = np.int64(s) * n + f
                count += 1
        elif j_is_leaf or (not i_is_leaf and first[i, 3] > second[j, 3]):  # divide the larger sphere
            stack[top, 0], stack[top, 1] = 2 * i + 1, j
            stack[top + 1, 0], stack[top + 1, 1] = 2 * i + 2, j
            top += 2
        else:
            stack[top, 0], stack[top, 1] = i, 2 * j + 1
            stack[top + 1, 0], stack[top + 1, 1] = i, 2 * j + 2
            top += 2
    return count


class SphereTree:
    """The tree over ``elements`` (m, 2) segments or (m, 3) triangles, divided at the places ``x`` (n, 3) mm.

    ``spheres`` (2 m - 1, 4): centre and radius, mm, of each node. Raises ValueError for wrong shapes.
    """

    def __init__(self, elements: np.ndarray, x: Array) -> None:
        corners = elements.shape[1] if elements.ndim == 2 and elements.shape[1] in (2, 3) else 3
        self.corners = corners
        elements = checked_elements(elements, corners, "elements")
        largest_magnitude(x, "nodes")
        # A segment is a triangle whose last two corners are one.
        self.elements = np.ascontiguousarray(elements[:, [0, 1, corners - 1]])
        self._last = int(elements.max(initial=-1))
        self._check_indices(x)
        self.leaf_element = _divide(x[self.elements].mean(axis=1)) if len(elements) else elements[:, 0]
        self.spheres = np.zeros((max(2 * len(elements) - 1, 0), 4))
        self.refit(x)

    def refit(self, x: Array) -> None:
        """Fit all spheres to the places ``x`` (n, 3) mm. Keeps ``x`` itself: searches compare the exact distances.

        Raises ValueError for places that are NaN, infinite or beyond 1e9 mm.
        """
        scale = largest_magnitude(x, "nodes")
        self._check_indices(x)
        self.x = x
        # Each of the at most 31 levels adds its rounding to the one below.
        self.rounding_mm = 4.0 * rounding_mm(scale)
        if len(self.elements):
            _refit(x, self.elements, self.leaf_element, self.spheres)

    def _check_indices(self, x: Array) -> None:
        if self._last >= len(x):
            raise ValueError(f"nodes: the elements name node {self._last}, found {len(x)} nodes")


class SphereSearch:
    """Search for near pairs of the elements of two trees: segments, and triangles or segments."""

    def __init__(self, segments: SphereTree, others: SphereTree) -> None:
        if segments.corners != 2:
            raise ValueError("the first tree of a search must be one of segments")
        self._segments, self._others = segments, others
        sizes = len(segments.elements), len(others.elements)
        # Each division replaces one pair by two, and there are as many divisions on a way down as levels in both trees.
        self._stack = np.zeros((sum(m.bit_length() + 1 for m in sizes) + 2, 2), dtype=np.int64)
        self._pairs = PairList(sizes)

    def near(self, margin_mm: float) -> np.ndarray:
        """The pairs (k, 2) int32 of a segment and an element of the other tree at most ``margin_mm`` apart, sorted.

        At the places of the last refits. The array is overwritten by the next search.
        """
        margin = checked_margin(margin_mm)
        a, b = self._segments, self._others
        if not len(a.elements) or not len(b.elements):
            return self._pairs.collect(lambda keys: 0)
        slack = a.rounding_mm + b.rounding_mm + rounding_mm(margin)
        return self._pairs.collect(
            lambda keys: int(
                _compare(
                    a.x, a.elements, a.leaf_element, a.spheres, b.x, b.elements, b.leaf_element, b.spheres,
                    margin, slack, self._stack, keys,
                )
            )
        )  # fmt: skip


def _divide(middles: Array) -> np.ndarray:
    """The element (m,) int32 at each leaf of the complete tree, from the elements' ``middles`` (m, 3).

    All parts of a level are divided at once: each is sorted along the longest side of its box, and its first elements
    go to the left child, as many as the left part of a complete tree has leaves.
    """
    m = len(middles)
    order = np.arange(m)
    sizes = np.array([m])
    while sizes.max() > 1:
        begin = np.cumsum(sizes) - sizes
        placed = middles[order]
        extent = np.maximum.reduceat(placed, begin) - np.minimum.reduceat(placed, begin)
        part = np.repeat(np.arange(len(sizes)), sizes)
        along = placed[np.arange(m), np.argmax(extent, axis=1)[part]]
        order = order[np.lexsort((along, part))]
        full = 1 << (np.frexp(sizes)[1] - 1)  # the largest power of two that is not larger
        left = np.where(sizes > 1, full // 2 + np.minimum(sizes - full, full // 2), 0)
        children = np.stack([left, sizes - left], axis=1).ravel()
        sizes = children[children > 0]
    # In the order of the leaves from left to right those of the deepest level come first; they end the heap.
    deepest = (1 << ((2 * m - 1).bit_length() - 1)) - 1
    heap = np.concatenate([np.arange(deepest, 2 * m - 1), np.arange(m - 1, deepest)])
    leaf_element = np.empty(m, dtype=np.int32)
    leaf_element[heap - (m - 1)] = order
    return leaf_element
