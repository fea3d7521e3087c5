"""Jones matrices of parameters in NumPy arrays, of whatever shape: compiled once for many shapes."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

from ..records import Parameters
from .base import Ordering

__all__ = ["jones_on_host"]

LEAST = 256  # so many at least are computed at once


def jones_on_host(ordering: Ordering, parameters: Parameters) -> np.ndarray:
    """``ordering.jones(parameters)`` as a NumPy array ``(*P, 2, 2)``, in the precision that JAX has enabled.

    JAX compiles for a shape, which takes longer than a frame of a million matrices: the parameters are laid in a row
    and filled up to one of few lengths, at most a quarter longer.

    >>> from . import RetarderFirst
    >>> jones_on_host(RetarderFirst(), Parameters(0.0, 0.0, np.zeros(3), 0.0, np.zeros((2, 1)))).shape
    (2, 3, 2, 2)
    """
    values = np.broadcast_arrays(*parameters)
    shape, count = values[0].shape, values[0].size
    step = max(1 << max(count.bit_length() - 3, 0), LEAST)
    row = np.zeros((len(values), -(-max(count, 1) // step) * step), np.result_type(*values, np.float32))
    row[:, :count] = [x.reshape(-1) for x in values]
    return np.asarray(_compiled(ordering, row))[:count].reshape(*shape, 2, 2)


@partial(jax.jit, static_argnums=0)
def _compiled(ordering: Ordering, row: jax.Array) -> jax.Array:
    return ordering.jones(Parameters(*row))
