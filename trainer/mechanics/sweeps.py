"""Local block sweeps: each node in turn goes to its own equilibrium, and a factor of over-relaxation beyond it.

The paper's relaxation moves a node along the force on it. Here the node takes a step of Newton's method for its three
coordinates, x_i ← x_i + ω B_i⁻¹ f_i with B_i the sum of its links' blocks (block Gauss–Seidel, or nonlinear block SOR:
Ortega and Rheinboldt 1970, section 7.4). B_i is made of the links' positive parts, and a step that does not lower the
energy of the node's own links is halved until it does; so the energy of the mesh never rises but by rounding.

ω is found, not given. Near the answer a sweep with ω multiplies the changes of the sweep before by some η < 1. Where
the blocks can be ordered consistently, η tells the spectral radius ρ of block Jacobi (Young 1954, Trans. AMS 76:92) by

    (η + ω - 1)² = η ω² ρ²,    and the best factor is    ω = 2 / (1 + sqrt(1 - ρ²)).

The first estimate is from sweeps with ω = 1; while η > ω - 1 the factor is still too small and the formula is used
again (Carré 1961, Comput. J. 4:73); once it is not, η says nothing more and ω stays. The formula overrates ρ when the
observed ratio is still growing or is near 1 by chance: an ω that stops the energy from falling is taken back.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.links import LinkMesh, energy
from trainer.mechanics.newton import Outcome, refuse_loose_nodes, refuse_not_finite
from trainer.mechanics.relaxation import breadth_first

