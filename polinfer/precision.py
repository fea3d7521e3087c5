"""Double precision for a piece of work, whatever JAX is set to.

JAX's setting is one of each thread. What is set here holds inside the ``with`` block, in this thread, and is gone after
it: nobody else's computation changes.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import jax
import numpy as np

__all__ = ["double_precision", "is_double"]


def is_double() -> bool:
    """Whether JAX computes in double precision in this thread."""
    return bool(jax.dtypes.canonicalize_dtype(np.float64) == np.float64)


def double_precision(wanted: bool = True) -> AbstractContextManager[Any]:
    """Inside the block JAX computes in double precision (or does not).

    >>> with double_precision():
    ...     is_double()
    True
    """
    switch: Any = getattr(jax, "enable_x64", None)
    if switch is None:  # where it was before JAX 0.8
        from jax import experimental

        switch = vars(experimental)["enable_x64"]
    return switch(wanted)
