"""Pieces of a link mesh that cuts have parted from all that is fixed: no link says where they are."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from trainer.geometry import Array, fit_rotation
from trainer.mechanics.links import LinkMesh


def loose_pieces(mesh: LinkMesh) -> list[np.ndarray]:
    """The nodes (k,) of each piece that links which bear join to one another and not to a fixed node, by first node."""
    n = len(mesh.rest)
    i, j = mesh.links[mesh.stiffness > 0.0].T
    count, piece = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)
    fixed = set(piece[mesh.fixed].tolist())
    return [np.flatnonzero(piece == k) for k in range(count) if k not in fixed]


def unstrained(rest: Array, x: Array) -> Array:
    """The places (k, 3) mm in which a piece that rests at ``rest`` (k, 3) bears nothing, those nearest to ``x`` (k, 3):
    its rest shape, carried there by the best rotation."""
    rotation = fit_rotation(rest, x)
    return np.asarray((rest - rest.mean(axis=0)) @ rotation.T + x.mean(axis=0))
