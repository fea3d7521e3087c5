"""Light meets the polariser, then the retarder."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from ..elements import multiply, polariser, retarder
from ..records import Parameters
from .base import Ordering
from .closed_form import diattenuator_of, elements, retarder_of

__all__ = ["PolariserFirst"]


@dataclass(frozen=True)
class PolariserFirst(Ordering):
    """``J = A_ret A_pol``, the reverse of the model of Gordon et al.

    >>> PolariserFirst().jones(Parameters(0.0, 0.0, 0.0, 0.0, 0.0)).real.tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """

    def jones(self, parameters: Parameters) -> jax.Array:
        p = parameters
        return multiply(
            retarder(p.retardance, p.retardance_angle, p.circularity),
            polariser(p.diattenuation, p.diattenuation_angle),
        )

    def decompose(self, jones: np.ndarray) -> Parameters:
        # J^H J is the conjugate of J^T (J^T)^H, of which D and its axis are the same; J A is the transpose of A J^T
        turned = elements(jones).transposed
        diattenuation, angle, polariser = diattenuator_of(turned)
        return Parameters(diattenuation, angle, *retarder_of(polariser.times(turned).transposed))
