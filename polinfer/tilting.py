"""A tilt put into matrices and statistics, and taken out of a measurement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from .checks import broadcast, one_of_types, real_array
from .records import Measurement
from .statistics import Statistics

__all__ = ["BALANCED", "tilt_of", "tilted", "tilted_statistics", "untilt"]

# |s| / s_0 of S = U U^H = s_0 + s . sigma up to which states count as balanced
BALANCED = {np.dtype(np.float64): 1e-11, np.dtype(np.float32): 1e-6}


def tilt_of(tilt: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A phase map that broadcasts to the pixel shape, checked."""
    phase = real_array("tilt", tilt, finite=True)
    if broadcast(tilt=phase.shape, measurement=shape) != shape:
        raise ValueError(f"tilt has shape {phase.shape}, more than the pixel shape {shape}; make them agree.")
    return phase


def tilted(jones: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """``T^-1 J T`` with ``T = diag(1, e^{i phi})``, of matrices ``(*P, 2, 2)`` and phases that broadcast to P.

    >>> tilted(np.ones((2, 2)), np.pi / 2).round(6).tolist()
    [[(1+0j), 1j], [-1j, (1+0j)]]
    """
    turn = np.exp(1j * np.asarray(phase))
    shape = np.broadcast_shapes(np.shape(jones)[:-2], turn.shape)
    found = np.array(np.broadcast_to(jones, (*shape, 2, 2)), np.result_type(jones, np.complex64))
    found[..., 0, 1] *= turn
    found[..., 1, 0] *= np.conj(turn)
    return found


def tilted_statistics(statistics: Statistics, phase: np.ndarray) -> Statistics:
    """Statistics of ``T U`` and ``T V``: those of the same data for the matrix without the tilt."""
    turn = np.exp(1j * np.asarray(phase))[..., None]

    def turned(values: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(values.shape[:-2], turn.shape[:-1])
        found = np.array(np.broadcast_to(values, (*shape, 2, 2)))
        found[..., 1, :] *= turn
        return found

    return statistics._replace(illumination=turned(statistics.illumination), response=turned(statistics.response))


def untilt(measurement: Measurement, tilt: Any) -> Measurement:
    """The measurement of the same sample without the tilt.

    Of ``V = g T^-1 J T U + noise`` with ``T = diag(1, e^{i phi})`` it is ``T V = g J (T U) + noise'``, where the noise
    is as before, because T is unitary. Where all pixels share balanced states (``U U^H`` proportional to 1) the
    illumination stays what it was: with ``Jhat = V U^H / s_0``, ``V' = T (V + (Jhat T^-1 - Jhat) U)`` has the same
    residual for every J. (The noise of single states is then mixed: do not leave one out afterwards.)

    Parameters
    ----------
    measurement: the data, pixel shape P. tilt: phi, radians, broadcasts to P, such as ``fit.tilt.phase``.

    Returns
    -------
    Measurement, for models without misalignment, :func:`polinfer.decompose`, :func:`polinfer.ordering_screen`.

    Raises
    ------
    ValueError, TypeError: a tilt that is not real and finite or does not broadcast.

    >>> import polinfer
    >>> truth, model = polinfer.Parameters(0.3, 0.5, 1.2, 0.4, 0.2), polinfer.Model()
    >>> data = polinfer.simulate(model, truth, np.eye(2), sigma=1e-6, rng=1, tilt=0.7)
    >>> bool(np.allclose(untilt(data, 0.7).response, model.jones(truth), atol=1e-5))
    True
    """
    one_of_types("measurement", measurement, (Measurement,), "pass a Measurement.")
    shape, n = measurement.shape, measurement.states
    phase = tilt_of(tilt, shape)
    kind = measurement.response.dtype
    turn = np.exp(1j * phase).astype(np.result_type(kind, np.complex64))
    response = np.broadcast_to(measurement.response, (*shape, 2, n))
    weight = np.ones(n) if measurement.weight is None else measurement.weight
    states = measurement.illumination.reshape(-1, n) if measurement.illumination.size == 2 * n else None
    if states is not None and weight.size == n:
        weight = weight.reshape(n)
        gram = (states * weight) @ states.conj().T
        size = 0.5 * np.trace(gram).real
        off = np.abs(gram - size * np.eye(2)).max()
        if size > 0 and off <= BALANCED[np.zeros((), kind).real.dtype] * size:
            # a missing state may hold anything
            seen = np.where(weight > 0, response, 0) if np.any(weight == 0) else response
            second = seen @ (weight * states[1].conj() / size).astype(kind)
            change = (turn.conj() - 1)[..., None] * second
            found = response + change[..., None] * states[1].astype(kind)
            found[..., 1, :] *= turn[..., None]
            return replace(measurement, response=found.astype(kind, copy=False))
    illumination = np.array(np.broadcast_to(measurement.illumination, (*shape, 2, n)))
    found = np.array(response)
    illumination[..., 1, :] *= turn[..., None]
    found[..., 1, :] *= turn[..., None]
    return replace(measurement, illumination=illumination, response=found)
