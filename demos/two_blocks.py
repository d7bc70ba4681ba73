"""Two blocks of very different stiffness, one pushed onto the other, against the closed form.

    python3 demos/two_blocks.py --plot two_blocks.png
"""

# %% [markdown]
# # Two blocks
#
# Two unit squares lie one upon the other between lateral rollers (plane strain, so each is an oedometer of modulus
# M = E (1 - nu) / ((1 + nu) (1 - 2 nu))). The lower one stands on the ground, the top of the upper one is pushed down by d.
# Each block shortens by a constant stretch s and carries the force
#
#     linear:                  F = M (1 - s)              F = d k1 k2 / (k1 + k2)  for the two in series
#     St Venant-Kirchhoff:     F = M s (1 - s^2) / 2
#
# Lagrange multipliers and penalties lose digits as the ratio of the moduli grows. An eliminated contactor does not.

# %%
import common
import numpy as np
import ufl
from common import comm, dirichlet
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx import compat

args = common.arguments(__doc__, n=4, d=0.1, steps=1, degree=1)
nu = 0.3
FORCE = {"linear": lambda s: 1 - s, "st_venant_kirchhoff": lambda s: s * (1 - s**2) / 2}
LAW = {"linear": uem.LinearElastic, "st_venant_kirchhoff": uem.StVenantKirchhoff}

# %% [markdown]
# ## The closed form
# The soft block shortens by d - w, the stiff one by w. Bisection on the balance of the two forces, in w, keeps the digits of w
# however small it is.

# %%
def shortening_of_stiffer(force, ratio: float, d: float) -> float:
    """Solve ratio * force(1 - w) = force(1 - d + w) for w, with ratio >= 1."""
    return bisect(lambda w: ratio * force(1 - w) - force(1 - d + w), 0.0, d)


def bisect(f, low: float, high: float) -> float:
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if f(middle) < 0 else (low, middle)
    return middle
