"""Maxima on or near a bound: the bounded angle is integrated over its range, the others as a Gaussian that follows it.

Along an angle at its bound the log density falls as ``-g t - h t^2 / 2`` with the distance t. Retardance is integrated
in closed form (a Gaussian cut at the bound), diattenuation numerically, with ``dD = cos delta d delta``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import erfcx, log_ndtr

from .describe import FROZEN, ROWS
from .scene import Scene

__all__ = ["correct_edges"]

NEAR = 3.0  # standard deviations from a bound within which it is felt
NODES, WEIGHTS = (np.asarray(x) for x in np.polynomial.legendre.leggauss(48))


def _covariance(out: np.ndarray, index: np.ndarray) -> np.ndarray:
    return out[ROWS["covariance"]][:, index].reshape(5, 5, -1).astype(float)


def _write(
    out: np.ndarray, index: np.ndarray, k: int, covariance: np.ndarray, turn: np.ndarray, mixed: np.ndarray,
    square: np.ndarray,
) -> None:  # fmt: skip
    """Moments of all parameters from those of the bounded one.

    ``turn`` is the second moment of its angle y, ``square`` that of the parameter, ``mixed`` that of their product.
    """
    follow = covariance[k].copy()
    follow[k] = 0
    covariance[k] = covariance[:, k] = 0
    covariance += follow[:, None] * follow[None] * turn
    covariance[k] = covariance[:, k] = follow * mixed
    covariance[k, k] = square
    out[ROWS["covariance"], index] = covariance.reshape(25, -1)
    out[ROWS["std"], index] = np.sqrt(np.einsum("iip->ip", covariance))


def _retardance(out: np.ndarray, frozen: np.ndarray) -> None:
    value, std = out[2].astype(float), out[7].astype(float)
    room = np.pi - np.abs(value)
    with np.errstate(invalid="ignore"):
        near = np.flatnonzero(~frozen & (room < NEAR * std) & (NEAR * std < 2 * np.pi))
    out[ROWS["log_evidence"], near] += log_ndtr(room[near] / std[near])
    index = np.flatnonzero(frozen)
    if len(index) == 0:
        return
    covariance = _covariance(out, index)
    width = np.sqrt(covariance[2, 2])  # of the angle eta/2, 1/sqrt(h)
    z = out[ROWS["slope_2"], index].astype(float) * width
    tail = erfcx(z / np.sqrt(2))
    out[ROWS["log_evidence"], index] += np.log(2 * width * np.sqrt(0.5 * np.pi) * tail)
    mills = np.sqrt(2 / np.pi) / tail
    # 1 + z^2 - z mills cancels at large z, where the density is exponential with a small correction
    inverse = 1 / np.maximum(z, 1) ** 2
    moment = np.where(z < 30, 1 + z * z - z * mills, 2 * inverse * (1 - inverse * (5 - 37 * inverse)))
    turn = width**2 * moment
    _write(out, index, 2, covariance, turn, 2 * turn, 4 * turn)


def _diattenuation(out: np.ndarray, frozen: np.ndarray) -> None:
    value, std = np.abs(out[0].astype(float)), out[5].astype(float)
    with np.errstate(invalid="ignore"):
        felt = (1 - value < NEAR * std) & (NEAR * std < 2)
    index = np.flatnonzero(frozen | felt)
    if len(index) == 0:
        return
    held = frozen[index]
    covariance = _covariance(out, index)
    delta = np.where(held, 0.5 * np.pi, np.arcsin(np.minimum(value[index], 1)))
    cosine = np.maximum(np.cos(delta), 1e-30)
    # where the density bends up from the bound (other angles are undetermined there) its slope alone counts
    along = np.where(covariance[0, 0] > 0, 2 * np.sqrt(covariance[0, 0]), np.inf)
    width = np.where(held, along, std[index] / cosine)
    slope = 0.5 * out[ROWS["slope_0"], index].astype(float)
    reach = np.minimum(8 * width, 40 / np.maximum(slope, 1e-30))
    low = np.maximum(delta - reach, -0.5 * np.pi)
    high = np.minimum(delta + reach, 0.5 * np.pi)
    x = 0.5 * (low + high) + 0.5 * (high - low) * NODES[:, None]
    away = delta - x
    density = np.exp(-slope * np.abs(away) - 0.5 * (away / width) ** 2) * np.cos(x) * WEIGHTS[:, None]
    total = density.sum(axis=0)
    evidence = np.log(total * 0.5 * (high - low))
    gaussian = np.where(held, 0, np.log(np.sqrt(2 * np.pi) * width * cosine))
    out[ROWS["log_evidence"], index] += evidence - gaussian
    if not held.any():
        return
    share = (density / total)[:, held]
    turn, step = 0.5 * (x - delta)[:, held], (np.sin(x) - 1)[:, held]
    moments = (np.sum(share * pair, axis=0) for pair in (turn * turn, turn * step, step * step))
    _write(out, index[held], 0, covariance[..., held], *moments)


def correct_edges(scene: Scene, out: np.ndarray, flags: np.ndarray) -> None:
    """Correct evidence, covariance and standard deviations in place."""
    corrections: dict[int, Any] = {2: _retardance} if scene.bounded else {}
    corrections[0] = _diattenuation
    for i, correct in corrections.items():
        if i in scene.free:
            with np.errstate(all="ignore"):  # pixels without an answer pass through
                correct(out, (flags & FROZEN[i]) != 0)
