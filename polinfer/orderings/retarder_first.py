"""Light meets the retarder, then the polariser."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from ..elements import multiply, polariser, retarder
from ..records import Parameters
from .base import Ordering
from .closed_form import diattenuator_of, elements, retarder_of

__all__ = ["RetarderFirst"]


@dataclass(frozen=True)
class RetarderFirst(Ordering):
    """``J = A_pol A_ret``, the model of Gordon et al.

    >>> RetarderFirst().jones(Parameters(0.0, 0.0, 0.0, 0.0, 0.0)).real.tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """

    def jones(self, parameters: Parameters) -> jax.Array:
        p = parameters
        return multiply(
            polariser(p.diattenuation, p.diattenuation_angle),
            retarder(p.retardance, p.retardance_angle, p.circularity),
        )

    def decompose(self, jones: np.ndarray) -> Parameters:
        matrix = elements(jones)
        diattenuation, angle, polariser = diattenuator_of(matrix)
        return Parameters(diattenuation, angle, *retarder_of(polariser.times(matrix)))
