"""Texture of the maps of a fit."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from ..checks import one_of_types
from ..gauge import smooth_gauge
from ..records import PERIODS, Fit, Parameters, Status
from .angles import Angle
from .base import Distribution
from .bounded import Bounded
from .chi import Chi
from .filters import describe
from .records import FitTexture

__all__ = ["of_fit"]


def of_fit(fit: Fit, size: int = 15, subtract_noise: bool = True, smooth: bool = False, fewest: int = 5) -> FitTexture:
    """Expectation and entropy of every inferred parameter, and of amplitude and phase of the gain.

    D is a truncated Gaussian, the angles are von Mises distributed with their periods (pi for axes), the amplitude is
    chi distributed with one degree of freedom. A pixel that has no answer counts nowhere, and one whose parameter is
    not identified does not count for that parameter: its angle would be a random number, and read as disorder.

    Parameters
    ----------
    fit: of any pixel shape. size, fewest: see :func:`describe`.
    subtract_noise: take the posterior widths, ``fit.std``, out of the entropies of the parameters. The gain has no
        widths; its entropies contain their noise.
    smooth: take the equivalent parameters that :func:`polinfer.smooth_gauge` chooses. Near ties of the rule by which a
        fit chooses, its maps flicker, which the entropy takes for disorder.

    Raises
    ------
    TypeError, ValueError: not a fit, a size out of range.

    >>> import polinfer
    >>> scene = polinfer.phantoms.lesion((12, 12), rng=1)
    >>> data = polinfer.simulate(polinfer.Model(), scene.parameters, np.eye(2), sigma=0.05, rng=1)
    >>> found = of_fit(polinfer.fit(polinfer.Model(), data), size=5)
    >>> found.retardance.entropy.shape, found.phase is None
    ((12, 12), True)
    """
    one_of_types("fit", fit, (Fit,), "pass the result of fit().")
    status = np.asarray(fit.status)
    answered = (status & int(Status.MASKED | Status.NON_FINITE | Status.NOT_CONVERGED)) == 0
    parameters = smooth_gauge(fit.parameters, status) if smooth else fit.parameters
    found: dict[str, Any] = {}
    for name in Parameters._fields:
        if name in fit.model.free:
            family: Distribution = Bounded(-1.0, 1.0) if name == "diattenuation" else Angle(getattr(PERIODS, name))
            known = answered & ((status & int(Status.unidentified(name))) == 0)
            width = getattr(fit.std, name) if subtract_noise else None
            found[name] = describe(getattr(parameters, name), size, family, known, width, fewest)
        else:
            found[name] = None
    gain = None if fit.gain is None else np.asarray(fit.gain)
    found["amplitude"] = None if gain is None else describe(np.abs(gain), size, Chi(1), answered, None, fewest)
    found["phase"] = None if gain is None else describe(np.angle(gain), size, Angle(2 * pi), answered, None, fewest)
    return FitTexture(**found, noise_subtracted=subtract_noise)
