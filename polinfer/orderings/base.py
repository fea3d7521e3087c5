"""What an ordering must offer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import jax
import numpy as np

if TYPE_CHECKING:
    from ..records import Parameters

__all__ = ["Ordering"]


class Ordering(ABC):
    """How the polariser and the retarder make up one Jones matrix.

    A new ordering is one frozen dataclass. It is composed of :func:`polinfer.elements.polariser` and
    :func:`polinfer.elements.retarder`, so that parameters which describe the same elements (:func:`polinfer.orbit`)
    describe the same matrix.

    >>> import dataclasses
    >>> from polinfer.elements import multiply, polariser, retarder
    >>> @dataclasses.dataclass(frozen=True)
    ... class Sandwich(Ordering):
    ...     def jones(self, p):
    ...         half = retarder(p.retardance / 2, p.retardance_angle, p.circularity)
    ...         return multiply(half, multiply(polariser(p.diattenuation, p.diattenuation_angle), half))
    >>> from polinfer import Parameters
    >>> Sandwich().jones(Parameters(*np.zeros((5, 4)))).shape
    (4, 2, 2)
    """

    @abstractmethod
    def jones(self, parameters: Parameters) -> jax.Array:
        """Jones matrices ``(*P, 2, 2)`` of parameters of shape P, written with ``jax.numpy``."""

    def decompose(self, jones: np.ndarray) -> Parameters | None:  # noqa: ARG002
        """Parameters of measured matrices ``(*P, 2, 2)`` up to a complex factor, or None: no closed form is known."""
        return None
