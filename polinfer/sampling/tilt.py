"""Draws of the tilt of a frame, and the pixels' draws moved along with it.

A pixel's draws are made for the most probable tilt. Those of the tilt come from the Gaussian of its posterior, the
pixels integrated out (:attr:`polinfer.Fit.tilt`), one for each draw, the same for all pixels of the frame. To it every
pixel is moved as its most probable parameters move, ``parameters + response (phi - phi_found)``: to first order the
joint posterior of tilt and pixels, and exact in what matters most, ``xi - phi`` of a retarder.
"""

from __future__ import annotations

import numpy as np

from ..degeneracy import reduce_ranges
from ..fitting.tilt import UNIFORM
from ..misalignment import TiltPlane
from ..model import Model
from ..records import PERIODS, Fit, Parameters, Status

__all__ = ["draw_coefficients", "move", "phase_of"]

STREAM = 0x7117  # apart from the pixels' random numbers


def _plane(model: Model) -> TiltPlane:
    assert isinstance(model.misalignment, TiltPlane)
    return model.misalignment


def draw_coefficients(found: Fit, chains: int, draws: int, seed: int) -> np.ndarray:
    """Coefficients ``(chain, draw, *frames, terms)``: they depend on the seed and the fit alone."""
    assert found.tilt is not None
    centre, covariance = found.tilt.coefficients, found.tilt.covariance
    rng = np.random.default_rng([seed % (1 << 63), STREAM])
    white = rng.normal(size=(chains, draws, *centre.shape))
    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0))[..., None, :]
    coefficients = centre + np.einsum("...kj,cd...j->cd...k", root, white)
    unknown = np.diagonal(covariance, axis1=-2, axis2=-1)[..., 0] >= UNIFORM**2
    even = np.pi * (rng.uniform(size=(chains, draws, *centre.shape[:-1])) - 0.5)
    coefficients[..., 0] = np.where(unknown, even, coefficients[..., 0])
    return np.asarray(coefficients)


def phase_of(model: Model, coefficients: np.ndarray, shape: tuple[int, ...], pixels: np.ndarray) -> np.ndarray:
    """phi of coefficients ``(..., *frames, terms)`` at pixels, flat indices: ``(..., pixels)``."""
    plane = _plane(model)
    left, right = plane.factors(shape)
    rows, columns = left.shape[1], right.shape[1]
    frame, place = np.divmod(pixels, rows * columns)
    lead = coefficients.shape[: coefficients.ndim - 1 - max(len(shape) - 2, 0)]
    each = coefficients.reshape(*lead, -1, len(plane.terms))
    basis = left[:, place // columns] * right[:, place % columns]
    if each.shape[-2] == 1:
        return np.asarray(each[..., 0, :] @ basis)
    return np.einsum("...pk,kp->...p", each[..., frame, :], basis)


def move(parameters: Parameters, found: Fit, coefficients: np.ndarray, pixels: np.ndarray) -> Parameters:
    """Draws ``(chain, draw, pixels)`` for the most probable tilt, moved to those of the tilt."""
    assert found.tilt is not None
    model, shape = found.model, found.status.shape
    change = phase_of(model, coefficients, shape, pixels)
    change -= phase_of(model, found.tilt.coefficients, shape, pixels)
    response = np.nan_to_num(found.tilt.response.reshape(-1, 5)[pixels].astype(float))
    # a phase that may be anything moves the circularity; what else it does is no matter of first order
    unknown = (found.status.reshape(-1)[pixels] & int(Status.TILT_UNIDENTIFIED)) != 0
    response[unknown] = np.eye(5)[4] * ("circularity" in model.free)
    values = {}
    for i, name in enumerate(Parameters._fields):
        value = np.asarray(getattr(parameters, name))
        if name in model.free:
            new = value + response[:, i] * change
            bounds = model.bounds.get(name)
            period = getattr(PERIODS, name)
            new = np.clip(new, *bounds) if bounds is not None else new - period * np.ceil(new / period - 0.5)
            value = new.astype(value.dtype)
        values[name] = value
    return reduce_ranges(Parameters(**values))
