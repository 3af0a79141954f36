"""The laws that a mesh's links may follow, one parameter for each link: constant, or shaped like a J (``link_tension``
has the curve); and stiffness that prefers a direction.

``replace(mesh, law=j_shaped(mesh, ...))`` is the same mesh with such links.
"""

from __future__ import annotations

import math

import numpy as np

from trainer.geometry import Array, unit
from trainer.mechanics.link_tension import LinkLaw
from trainer.mechanics.links import LinkMesh


def constant(mesh: LinkMesh) -> LinkLaw:
    """Links of constant stiffness, that of the mesh."""
    zero = np.zeros(len(mesh.links))
    return LinkLaw(mesh.stiffness, zero, zero, zero, mesh.stiffness)


def j_shaped(mesh: LinkMesh, growth: float | Array, toe_strain: float | Array, loss: float | Array = 0.0) -> LinkLaw:
    """J-shaped links: the mesh's stiffness at rest, ``growth`` per unit of strain up to ``toe_strain``.

    Each number is one for all links or one for each (m,). Raises ValueError where the growth or the toe is negative
    or not finite, where the tangent grows beyond what a float holds, or where the loss is not in 0 … 1.
    """
    growth, toe_strain, loss = (
        np.broadcast_to(np.asarray(a, dtype=np.float64), mesh.rest_length.shape) for a in (growth, toe_strain, loss)
    )
    for name, value in (("growth", growth), ("toe_strain", toe_strain)):
        if not np.all((value >= 0.0) & (value < np.inf)):
            raise ValueError(f"'{name}' of a J-shaped link must be finite and not negative, found {np.min(value):g}")
    if not np.all((loss >= 0.0) & (loss < 1.0)):
        raise ValueError("'loss' of a J-shaped link must be at least 0 and less than 1")
    with np.errstate(over="ignore"):
        steepest = mesh.stiffness * np.exp(growth * toe_strain)
    if not np.all(np.isfinite(steepest)):
        raise ValueError(f"'growth' times 'toe_strain' is too large: {np.max(growth * toe_strain):g}")
    length = mesh.rest_length
    return LinkLaw(mesh.stiffness, growth / length, toe_strain * length, loss.copy(), steepest)


def steepest_tangent(law: LinkLaw) -> Array:
    """The largest derivative (m,) mN/mm that each link's tension can have, whatever its elongation and its past."""
    return np.where(law.loss > 0.0, (2.0 - law.loss) * law.friction, law.friction)


def stiffened_along(mesh: LinkMesh, direction: Array, ratio: float) -> Array:
    """The mesh's stiffness (m,) mN/mm, times 1 + (ratio - 1) cos² of the link's angle to ``direction`` (3,) at rest.

    A link along the direction is ``ratio`` times as stiff, one across it as stiff as before. What becomes of the
    moduli is said by :func:`moduli_along`. Raises ValueError for a ratio that is not positive.
    """
    if not 0.0 < ratio < math.inf:
        raise ValueError(f"'ratio' of the stiffness along a direction must be positive, found {ratio:g}")
    along = (mesh.rest[mesh.links[:, 1]] - mesh.rest[mesh.links[:, 0]]) @ unit(direction)
    squared = np.sum((mesh.rest[mesh.links[:, 1]] - mesh.rest[mesh.links[:, 0]]) ** 2, axis=1)
    return np.asarray(mesh.stiffness * (1.0 + (ratio - 1.0) * along * along / squared))


def moduli_along(modulus_kPa: float, ratio: float) -> tuple[float, float]:
    """Young's moduli along and across, kPa, of a mesh of ``modulus_kPa`` after :func:`stiffened_along`.

    For links distributed evenly over the sphere, Σ k L² = 6 E V as in ``stiffness_from_modulus``. With b = ratio - 1
    and the axis 1 along the direction, C_ijkl = 6 E <(1 + b n_1²) n_i n_j n_k n_l>. The averages <n_1⁴> = 1/5,
    <n_1² n_2²> = 1/15, <n_1⁶> = 1/7, <n_1⁴ n_2²> = 1/35 and <n_1² n_2² n_3²> = 1/105 give, in units of 6 E,

        C_11 = 1/5 + b/7,  C_22 = 1/5 + b/35,  C_12 = 1/15 + b/35,  C_23 = 1/15 + b/105,

    a solid that is isotropic around the axis. A bar along the axis has the modulus C_11 - 2 C_12² / (C_22 + C_23);
    one across it 1 / S_22 of the inverse matrix, which is (C_22 - C_23) D / (C_11 C_22 - C_12²), D being
    (C_11 (C_22 + C_23) - 2 C_12²).
    """
    b = ratio - 1.0
    c11, c22, c12, c23 = 1 / 5 + b / 7, 1 / 5 + b / 35, 1 / 15 + b / 35, 1 / 15 + b / 105
    d = c11 * (c22 + c23) - 2.0 * c12 * c12
    scale = 6.0 * modulus_kPa
    return scale * d / (c22 + c23), scale * (c22 - c23) * d / (c11 * c22 - c12 * c12)
