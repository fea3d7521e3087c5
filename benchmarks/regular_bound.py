"""The least error of J, or of the fields behind the sample, where the parameters themselves may be undefined.

The matrices that a model can give are a smooth surface also where angles are undefined: at eta = 0 the retarder moves
in three directions, at D = 0 the diattenuator in two. The bound of an unbiased estimate is the noise in these
directions, as in :func:`benchmarks.scenes.least_squared_error`, which has it from the parameters, and with which it
agrees elsewhere.
"""

from __future__ import annotations

import numpy as np

from benchmarks import scenes
from polinfer import Model, Parameters, RetarderFirst


def tangents(model: Model, truth: Parameters) -> np.ndarray:
    """Directions in which J can move, complex (pixels, 5, 2, 2), by paper: regular where angles are undefined."""
    delta, axis = np.arcsin(np.asarray(truth.diattenuation)), np.asarray(truth.diattenuation_angle)
    z, x, y = np.array([[1, 0], [0, -1]]), np.array([[0, 1], [1, 0]]), np.array([[0, -1j], [1j, 0]])
    one = np.eye(2)

    def spread(v: np.ndarray) -> np.ndarray:
        return v[:, None, None]

    along = spread(np.cos(2 * axis)) * z - spread(np.sin(2 * axis)) * x
    across = -spread(np.sin(2 * axis)) * z - spread(np.cos(2 * axis)) * x
    c, s = spread(np.cos(delta / 2)), spread(np.sin(delta / 2))
    polariser = c * one + s * along
    retarder = scenes.jones(Model(model.ordering), truth._replace(diattenuation=np.zeros(delta.shape)))
    moved = [0.5 * (c * along - s * one), across]
    turned = [1j * (m @ retarder) for m in (z, x, y)]
    if isinstance(model.ordering, RetarderFirst):
        directions = [m @ retarder for m in moved] + [polariser @ m for m in turned]
    else:
        directions = [retarder @ m for m in moved] + [m @ polariser for m in turned]
    return np.stack(directions, axis=1)


def bound(model: Model, truth: Parameters, states: np.ndarray, sigma: float, kind: str) -> np.ndarray:
    """Least mean square error modulo the gain, (pixels,), of J or of the field J U."""
    centre, moves = scenes.jones(Model(model.ordering), truth), tangents(model, truth)
    gains = [] if model.gain is None else [centre, 1j * centre]
    moves = np.concatenate([moves, *(g[:, None] for g in gains)], axis=1)
    seen = moves @ states[:, None]
    flat, data = (np.concatenate([v.real, v.imag], -1).reshape(*v.shape[:2], -1) for v in (moves, seen))
    if kind == "field":
        return sigma**2 / 2 * (np.linalg.matrix_rank(data, tol=1e-6) - len(gains))
    covariance = sigma**2 / 2 * np.linalg.pinv(data @ data.swapaxes(-1, -2), rcond=1e-12, hermitian=True)
    if gains:
        own = flat[:, 5:] / np.linalg.norm(flat[:, 5:], axis=-1, keepdims=True)
        flat = flat - (flat @ own.swapaxes(-1, -2)) @ own
    return np.einsum("nik,nij,njk->n", flat, covariance, flat)


def squared_error(model: Model, truth: Parameters, states: np.ndarray, point: np.ndarray, kind: str) -> np.ndarray:
    """Of points ``(5, pixels)``, like :func:`bound`."""
    true = scenes.jones(Model(model.ordering), truth)
    found = scenes.jones(Model(model.ordering), Parameters(*point))
    if kind == "field":
        found, true = found @ states, true @ states
        if model.gain is not None:
            factor = np.sum(found.conj() * true, axis=(-1, -2)) / np.sum(np.abs(found) ** 2, axis=(-1, -2))
            found = factor[:, None, None] * found
        return np.sum(np.abs(found - true) ** 2, axis=(-1, -2))
    return scenes.squared_error(model, found, true)


def disagreement(model: Model, rng: np.random.Generator, pixels: int = 200) -> float:
    """Largest relative difference from the bound by way of the parameters, where all of these are well determined."""
    states = scenes.balanced_states()
    truth = scenes.well_determined(model, pixels, states, 0.01, rng)
    shared = np.broadcast_to(states, (pixels, *states.shape))
    other = scenes.least_squared_error(model, truth, states, 0.01)
    return float(np.max(np.abs(bound(model, truth, shared, 0.01, "J") / other - 1)))
