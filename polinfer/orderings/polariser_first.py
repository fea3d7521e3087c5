"""Light meets the polariser, then the retarder."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from ..elements import multiply, polariser, retarder
from ..records import Parameters
from .base import Ordering
from .closed_form import diattenuator_of, retarder_of

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
        diattenuation, angle, matrix = diattenuator_of(np.conj(np.swapaxes(jones, -1, -2)) @ jones)
        return Parameters(diattenuation, angle, *retarder_of(jones @ matrix))
