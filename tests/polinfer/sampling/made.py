"""Draws without a sampler: independent ones around a point, and what the tests of the records share."""

import numpy as np

from polinfer import Measurement, Model, Parameters
from polinfer.sampling.draws import Draws

CENTRE = (0.3, 0.5, 1.2, 0.4, 0.7)


def around(shape=(), chains=4, count=250, width=0.05, seed=0, centre=CENTRE, dtype=float):
    """Five arrays ``(chain, draw, *shape)``, normal around a point."""
    rng = np.random.default_rng(seed)
    return Parameters(*(rng.normal(c, width, (chains, count, *shape)).astype(dtype) for c in centre))


def draws_of(model=None, shape=(), parameters=None, measurement=None, status=None, gain=None, sigma=None, **kwargs):
    """A record of draws of a frame; the data are the identity unless given."""
    model = Model() if model is None else model
    if measurement is None:
        response = np.broadcast_to(np.eye(2, dtype=complex), (*shape, 2, 2))
        measurement = Measurement(np.eye(2), response, None if sigma is not None else np.array(0.1))
    parameters = around(shape, **kwargs) if parameters is None else parameters
    status = np.zeros(shape, np.int32) if status is None else np.asarray(status, np.int32)
    empty = np.full(shape, np.nan)
    return Draws(model, measurement, parameters, empty, empty, status, gain, sigma, 7, None)


def autoregressive(coefficient, shape, rng):
    """Stationary AR(1) of variance 1 along axis 1 of ``(chain, draw, ...)``."""
    from scipy.signal import lfilter

    noise = rng.normal(size=shape)
    noise[:, 1:] *= (1 - coefficient**2) ** 0.5
    return lfilter([1.0], [1.0, -coefficient], noise, axis=1)
