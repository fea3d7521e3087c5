"""Where to start: the closed form and its twin, and a fixed quasi-random design.

Data with little noise or of balanced states are settled by the closed form. The design finds the best basin where
they are not: unbalanced states, strong priors, orderings without a closed form. It is the same for every pixel and
every run.
"""

from __future__ import annotations

from functools import cache, partial
from math import pi

import jax
import jax.numpy as jnp
import numpy as np

from ..model import Model
from ..neighbours import Windowed, mean_jones
from ..records import Parameters
from ..statistics import Statistics
from .charts import from_parameters, to_parameters

__all__ = ["starts"]

DESIGN = 192


@cache
def _design(model: Model) -> np.ndarray:
    """Points ``(DESIGN, free)`` in chart coordinates, spread over the ranges."""
    from scipy.stats import qmc  # slow to import

    unit = qmc.Halton(len(model.free), scramble=False).random(DESIGN + 1)[1:]  # the first is a corner
    # half a period of the sine covers a bounded parameter once; a circle is covered by its period
    spans = [pi if name in model.bounds or name.endswith("_angle") else 2 * pi for name in model.free]
    return np.asarray((unit - 0.5) * spans)


@partial(jax.jit, static_argnums=(0, 1))
def _best_of_design(model: Model, count: int, statistics: Statistics | Windowed) -> jax.Array:
    points = jnp.asarray(_design(model), statistics.residual.dtype)
    one_more = jax.tree.map(lambda x: x[None], statistics)
    spread = jax.tree.map(lambda x: x[:, None], to_parameters(model, points))
    _, best = jax.lax.top_k(model.log_density(spread, one_more).T, count)
    return points[best]


def starts(
    model: Model,
    summary_statistics: Statistics | Windowed,
    statistics: Statistics | Windowed,
    earlier: Parameters | None,
    count: int,
) -> np.ndarray:
    """Starting coordinates ``(pixels, starts, free)`` of a chunk of pixels.

    ``summary_statistics`` are the NumPy statistics, ``statistics`` the same on the device; ``earlier`` are parameters
    from a fit of similar data, which then lead; ``count`` points are taken from the design.
    """
    chosen = []
    closed = model.ordering.decompose(mean_jones(summary_statistics, aligned=not model.known_gain.free_phase))
    if earlier is not None:
        known = [np.asarray(x, float) for x in earlier]
        if closed is not None:
            known = [np.where(np.isfinite(x), x, y) for x, y in zip(known, closed, strict=True)]
        chosen.append(Parameters(*(np.where(np.isfinite(x), x, 0.1) for x in known)))
    if closed is not None:
        twin = closed._replace(circularity=closed.circularity + pi, retardance_angle=-closed.retardance_angle)
        chosen += [closed, twin]
    # symmetric points can be saddles with a vanishing gradient, and an exact bound has none: step off both
    columns = [from_parameters(model, p) * (1 - 1e-4) + 1e-4 for p in chosen]
    designed = np.asarray(_best_of_design(model, count, statistics))
    return np.concatenate([np.stack(columns, axis=1), designed], axis=1) if columns else designed
