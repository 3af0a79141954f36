"""What bodies do when the occupancy map says that they touch (Gibson et al. 1998, 3.3).

The paper's plan for volumes, which touch at many elements: average the contacts over the region of contact and answer
that one. The mean point, the mean normal and the mean overlap along it push a rigid body away and turn it; elements of
tissue are each pushed by the mean of what their contacts ask for, and ChainMail takes their neighbours along.

Two elements overlap by how much nearer they are along the normal than one cell of the map. Normals are those of the
surface elements: away from the links that an element has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array, Rigid, cross, quaternion_from_axis_angle
from trainer.mechanics.volume import STEPS, Indices, VolumeState


@dataclass(frozen=True)
class Region:
    """All contacts of two bodies as one."""

    point: Array  # (3,) mm
    normal: Array  # (3,) unit vector from the first body to the second
    overlap_mm: float  # by which the second must move along the normal, on average; above 0
    pairs: int


def surface_normals(state: VolumeState, elements: Indices) -> Array:
    """Outward unit normals (k, 3) of surface elements, by the links that they lack; 0 where these cancel out."""
    lacking = ((state.links[elements][:, None] >> np.arange(6)) & 1) == 0
    out = lacking @ np.array(STEPS, dtype=np.float64)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.asarray(np.divide(out, length, out=np.zeros_like(out), where=length > 0.0))


def region(points: Array, normals: Array, pairs: np.ndarray, cell_mm: float) -> Region | None:
    """The mean of the contacts ``pairs`` (k, 2) between entries at ``points`` (s, 3) mm with ``normals`` (s, 3).

    The first of each pair belongs to the one body, the second to the other. None if there is no contact, or it has no
    direction: neither normals nor the way from the one to the other say where to.
    """
    if not len(pairs):
        return None
    one, other = pairs[:, 0], pairs[:, 1]
    way = np.mean(normals[one] - normals[other], axis=0)
    if np.linalg.norm(way) < 1e-9:
        way = np.mean(points[other] - points[one], axis=0)
    length = float(np.linalg.norm(way))
    if length < 1e-9:
        return None
    normal = way / length
    overlaps = cell_mm - (points[other] - points[one]) @ normal
    overlap = float(np.mean(np.maximum(overlaps, 0.0)))
    return (
        Region(np.mean(0.5 * (points[one] + points[other]), axis=0), normal, overlap, len(pairs))
        if overlap > 0.0
        else None
    )


def push(contact: Region, pose: Rigid, centre: Array, gyration_mm: float) -> Rigid:
    """The pose of the second body, moved and turned by the least that undoes the mean overlap.

    ``centre`` (3,) mm is the body's middle in the world and ``gyration_mm`` its radius of gyration: of all motions that
    lift the contact point by the overlap along the normal this is the one with the least mean square way of the body.
    """
    lever = cross(contact.point - centre, contact.normal) / gyration_mm**2
    share = contact.overlap_mm / (1.0 + gyration_mm**2 * float(lever @ lever))
    turn = share * lever
    angle = float(np.linalg.norm(turn))
    spin = Rigid(np.zeros(3), quaternion_from_axis_angle(turn, angle)) if angle > 1e-12 else Rigid.identity()
    moved = spin.apply(pose.position - centre) + centre + share * contact.normal
    return Rigid(moved, (spin @ pose).quaternion)


def push_out(
    points: Array, normals: Array, pairs: np.ndarray, soft: np.ndarray, cell_mm: float
) -> tuple[Indices, Array]:
    """Entries (k,) of tissue that touch something, and by how much each is to move, (k, 3) mm.

    ``soft`` (s,) says which entries are tissue: against rigid ones they go all the way, against each other half.
    """
    one, other = pairs[:, 0], pairs[:, 1]
    way = normals[one] - normals[other]
    length = np.linalg.norm(way, axis=1, keepdims=True)
    normal = np.divide(way, length, out=np.zeros_like(way), where=length > 1e-9)
    overlap = np.maximum(cell_mm - np.sum((points[other] - points[one]) * normal, axis=1), 0.0)[:, None] * normal
    share = np.where(soft[one] & soft[other], 0.5, 1.0)[:, None]
    touched, at = np.unique(pairs, return_inverse=True)
    at = at.reshape(pairs.shape)
    total = np.zeros((len(touched), 3))
    np.add.at(total, at[:, 0], -share * overlap)
    np.add.at(total, at[:, 1], share * overlap)
    mean = total / np.bincount(at.ravel(), minlength=len(touched))[:, None]
    pushed = soft[touched] & np.any(mean != 0.0, axis=1)
    return touched[pushed].astype(np.int32), mean[pushed]
