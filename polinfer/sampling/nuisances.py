"""Gain and sigma of a pixel given its matrix: independent draws from their exact joint conditional (NumPy).

With ``M = J R``, data Y and E of the pixel, ``a = <M, Y>`` and ``m = |M|^2``: where sigma is known (data in units
of it) the phase of a gain is von Mises with mean arg a and concentration 2 |a|, and a complex gain is normal with
precision ``m + 1 / scale^2`` and mean a over it. Where sigma is inferred, ``1 / sigma^2`` is drawn first, the gain
integrated out, then the gain given it.
"""

from __future__ import annotations

import numpy as np
from scipy.special import i0e

from ..gain import ComplexGain, PhaseGain, UnitGain
from ..model import Model
from ..noise import InferredNoise
from ..statistics import Statistics

__all__ = ["draw_nuisances"]

NODES, BLOCK = 1024, 512  # of the table from which 1 / sigma^2 is drawn; draws that are tabulated at once
HIGHEST = 0.46883  # of sqrt(x) I_0(x) e^-x


def draw_nuisances(
    model: Model, own: Statistics, matrices: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Gain (complex) and sigma, both ``(draws,)``, for Jones matrices ``(draws, 2, 2)``; None where not inferred.

    ``own`` are the statistics of the pixel itself, without pixel axes.

    Raises
    ------
    TypeError: a gain of another kind.
    """
    gain = model.known_gain
    if not isinstance(gain, UnitGain | PhaseGain | ComplexGain):
        raise TypeError(
            f"gain {type(gain).__name__} has no known conditional; pass PhaseGain(), ComplexGain() or None."
        )
    response = np.asarray(own.response, complex)
    seen = matrices @ np.asarray(own.illumination, complex)
    overlap, size = np.sum(np.conj(seen) * response, axis=(-1, -2)), np.sum(np.abs(seen) ** 2, axis=(-1, -2))
    inferred = isinstance(model.noise, InferredNoise) and model.noise.integrated
    if inferred:
        assert isinstance(model.noise, InferredNoise)
        precision = _precision(model.noise, gain, own, seen, overlap, size, rng)
    else:
        precision = np.ones(len(seen))
    drawn = None
    if isinstance(gain, PhaseGain):
        drawn = np.exp(1j * rng.vonmises(np.angle(overlap), 2 * precision * np.abs(overlap)))
    elif isinstance(gain, ComplexGain):
        total = precision * size + 1 / gain.scale**2
        normal = rng.normal(size=(2, len(seen)))
        drawn = precision * overlap / total + (normal[0] + 1j * normal[1]) / np.sqrt(2 * total)
    return drawn, precision**-0.5 if inferred else None


def _precision(
    noise: InferredNoise,
    gain: UnitGain | PhaseGain | ComplexGain,
    own: Statistics,
    seen: np.ndarray,
    overlap: np.ndarray,
    size: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draws of ``1 / sigma^2``, the gain integrated out."""
    response = np.asarray(own.response, complex)
    power, rest = noise.shape + float(own.count), noise.scale + float(own.residual)
    if isinstance(gain, UnitGain):
        return np.asarray(rng.gamma(power, size=len(seen)) / (rest + _square(seen - response)))
    modulus = np.abs(overlap)
    if isinstance(gain, PhaseGain):
        turned = np.where(modulus > 0, overlap / np.where(modulus > 0, modulus, 1), 1)
        least = rest + _square(turned[:, None, None] * seen - response)
        return _phase_precision(power, 2 * modulus / least, rng) / least
    best = overlap / np.where(size > 0, size, 1)
    least = rest + _square(best[:, None, None] * seen - response)
    return _gain_precision(power, least, modulus**2 / np.where(size > 0, size, 1), gain.scale**2 * size, rng)


def _square(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.sum(x.real**2 + x.imag**2, axis=(-1, -2)))


def _phase_precision(power: float, ratio: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draws of density ``x^(power - 1) e^-x I_0(ratio x) e^(-ratio x)``, by rejection from gamma draws.

    For large ``ratio x`` the Bessel function falls off like ``x^-1/2``, which the power of the gamma draws then has.
    """
    found = np.empty(len(ratio))
    left = np.arange(len(ratio))
    while len(left):
        own = ratio[left]
        steep = own * power > 1
        tried = rng.gamma(np.where(steep, power - 0.5, power) if power > 0.5 else power, size=len(left))
        steep &= power > 0.5
        bessel = i0e(own * tried)
        accept = np.where(steep, np.sqrt(own * tried) * bessel / HIGHEST, bessel)
        taken = rng.uniform(size=len(left)) < accept
        found[left[taken]] = tried[taken]
        left = left[~taken]
    return found


def _gain_precision(
    power: float, least: np.ndarray, signal: np.ndarray, width: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Draws of ``t^(power - 1) exp(-t least - signal t / (1 + width t)) / (1 + width t)``, from a table over log t."""
    found = np.empty(len(least))
    reach = 12 / np.sqrt(power) + 40 / power  # beyond, less than e^-30 of the peaks
    for begin in range(0, len(least), BLOCK):
        part = slice(begin, begin + BLOCK)
        a, s, b = (x[part, None] for x in (least, signal, width))
        low = np.log(power / (a + s)) - reach - 1
        high = np.log(power / a) + np.log1p(reach)
        x = low + (high - low) * np.linspace(0, 1, NODES)
        t = np.exp(x)
        logs = power * x - t * a - s * t / (1 + b * t) - np.log1p(b * t)
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        steps = np.cumsum(0.5 * (weights[:, 1:] + weights[:, :-1]), axis=1)
        uniform = rng.uniform(size=len(a)) * steps[:, -1]
        place = np.minimum((steps < uniform[:, None]).sum(axis=1), NODES - 2)
        rows = np.arange(len(a))
        before = np.where(place > 0, steps[rows, np.maximum(place - 1, 0)], 0.0)
        share = (uniform - before) / np.maximum(steps[rows, place] - before, 1e-300)
        # the density is a straight line within a step
        left, right = weights[rows, place], weights[rows, place + 1]
        slope = right - left
        area = 0.5 * share * (left + right)
        inside = 2 * area / np.maximum(left + np.sqrt(np.maximum(left**2 + 2 * slope * area, 0)), 1e-300)
        found[part] = np.exp(x[rows, place] + inside * (x[:, 1] - x[:, 0]))
    return found
