"""Joint distributions of several angles in sliding windows."""

from __future__ import annotations

from functools import reduce
from math import log
from typing import Any

import numpy as np

from ..checks import boolean_array, integer, one_of_types, real_array
from ..neighbours import plane
from .angles import Angle, Rescaled
from .base import Distribution
from .frames import broadcast_to, check_range, checked_size
from .joint import Joint, score_matching, terms
from .quadrature import joint_entropy
from .windows import Sweep, sweep

__all__ = ["each_of", "joint_filtered"]


class _JointFrame(Sweep):
    """One frame of several angles; ``out`` is filled with the entropy of every ``stride``-th window."""

    def __init__(
        self, angles: list[np.ndarray], noise: list[np.ndarray] | None, used: np.ndarray, model: Joint, fewest: int,
        stride: int, out: np.ndarray,
    ) -> None:  # fmt: skip
        self.angles, self.noise, self.used = angles, noise, used
        self.model, self.fewest, self.stride, self.out = model, fewest, stride, out
        self.terms = terms(model, len(angles))
        self.waves = len(self.terms.frequencies)
        # noise blurs waves of the same frequencies up to signs alike
        self.blurs = sorted({tuple(abs(k) for k in f) for f in self.terms.frequencies}) if noise is not None else []
        self.features = 2 * self.waves + len(self.blurs) + 1

    def load(self, rows: slice, out: np.ndarray) -> None:
        used = self.used[rows]
        turns = [np.exp(1j * np.where(used, x[rows], 0)) for x in self.angles]
        powers: dict[tuple[int, int], np.ndarray] = {}
        for place, frequency in enumerate(self.terms.frequencies):
            wave = used.astype(complex)
            for j, k in enumerate(frequency):
                if k:
                    power = powers.setdefault((j, abs(k)), turns[j] ** abs(k))
                    wave = wave * (power if k > 0 else np.conj(power))
            out[2 * place], out[2 * place + 1] = wave.real, wave.imag
        for place, frequency in enumerate(self.blurs):
            parts = [
                0.5 * k * k * np.where(used, s[rows], 0) ** 2 for k, s in zip(frequency, self.noise or (), strict=True)
            ]
            out[2 * self.waves + place] = np.exp(-reduce(np.add, parts)) * used
        out[-1] = used

    def finish(self, rows: slice, sums: np.ndarray, spare: np.ndarray) -> None:  # noqa: ARG002
        wide, step = self.used.shape[1], self.stride
        first = -rows.start % step
        lines = slice(first, rows.stop - rows.start, step)
        taken = sums.reshape(self.features, rows.stop - rows.start, -1)[:, lines, :wide:step]
        if not taken.size:
            return
        shape = taken.shape[1:]
        taken = taken.reshape(self.features, -1)
        count = taken[-1]
        enough = count >= self.fewest
        entropy = np.full(count.shape, np.nan)
        taken, count = taken[:, enough], count[enough]
        means = (taken[0 : 2 * self.waves : 2] + 1j * taken[1 : 2 * self.waves : 2]) / count
        if self.blurs:
            where = [self.blurs.index(tuple(abs(k) for k in f)) for f in self.terms.frequencies]
            means = means * (count / taken[2 * self.waves : -1][where])
        d = len(self.angles)
        directions = [means[self.terms.frequencies.index(tuple(int(i == j) for i in range(d)))] for j in range(d)]
        unit = [np.conj(m) / np.where(np.abs(m) > 0, np.abs(m), 1) for m in directions]
        for place, frequency in enumerate(self.terms.frequencies):
            for j, k in enumerate(frequency):
                if k:
                    means[place] *= unit[j] ** k if k > 0 else np.conj(unit[j]) ** -k
        parameters, point, singular = score_matching(self.terms, means, noisy=self.noise is not None)
        parameters[singular] = self.model.singular
        parameters[point] = np.inf
        found = joint_entropy(self.model, parameters, np.abs(np.array(directions)).T)
        entropy[enough] = found + _correction(count, d, self.model.degrees(d))
        begin = (rows.start + first) // step
        self.out[begin : begin + shape[0]] = entropy.reshape(shape)


def _correction(count: np.ndarray, angles: int, degrees: int) -> np.ndarray:
    """What entropies of few pixels lack on average: that of a Gaussian, exactly, and half of each further parameter.

    The log determinant of a covariance of n draws in d dimensions loses ``log(n / 2) - digamma((n - i) / 2)`` for each
    i from 1 to d.
    """
    from scipy.special import digamma

    count = np.maximum(count, angles + 1)
    gaussian = sum(np.log(0.5 * count) - digamma(0.5 * (count - i)) for i in range(1, angles + 1))
    further = degrees - angles * (angles + 3) // 2
    return 0.5 * np.asarray(gaussian) + 0.5 * further / count


def joint_filtered(
    values: list[np.ndarray], size: int, families: list[Distribution], mask: Any, widths: list[Any], fewest: int,
    stride: int, model: Joint,
) -> np.ndarray:  # fmt: skip
    """Joint entropy of several images, after a check of the arguments; every ``stride``-th row and column."""
    one_of_types("joint", model, (Joint,), "pass MultivariateVonMises() or TorusGraph().")
    if not values:
        raise ValueError("images is an empty list; pass at least one image.")
    if len({x.shape for x in values}) > 1:
        raise ValueError(f"images must have one shape, got {', '.join(str(x.shape) for x in values)}.")
    size, fewest = checked_size(size), integer("fewest", fewest, low=3)
    shape = values[0].shape
    used = np.ones(shape, bool) if mask is None else broadcast_to("mask", boolean_array("mask", mask), shape).copy()
    for x in values:
        used &= np.isfinite(x)
    angles, noise, jacobian = [], [], 0.0
    for i, (x, family, width) in enumerate(zip(values, families, widths, strict=True)):
        angle = family.angle if isinstance(family, Rescaled) else family
        if not isinstance(angle, Angle):
            raise TypeError(f"distribution of images[{i}] is {family!r}: joint distributions are of angles; pass "
                            "Rescaled(centre, scale) for what is none.")  # fmt: skip
        check_range(f"images[{i}]", x, used, family)
        centre = family.centre if isinstance(family, Rescaled) else 0.0
        angles.append(angle.frequency * (x.astype(float) - centre))
        jacobian -= log(angle.frequency)
        s = np.zeros(shape) if width is None else broadcast_to("std", real_array("std", width, low=0), shape)
        used &= np.isfinite(s)
        noise.append(angle.frequency * s)
    rows, columns = plane(shape)
    frames = [x.reshape(-1, rows, columns) for x in (used, *angles, *noise)]
    d, noisy = len(values), any(w is not None for w in widths)
    result = np.full((len(frames[0]), -(-rows // stride), -(-columns // stride)), np.nan)
    for out, inside, *one in zip(result, *frames, strict=True):
        frame = _JointFrame(one[:d], one[d:] if noisy else None, inside, model, max(fewest, model.degrees(d) + 1),
                            stride, out)  # fmt: skip
        sweep(frame, (rows, columns), size, np.dtype(np.float64))
    kept = np.float32 if all(x.dtype == np.float32 for x in values) else np.float64
    return (result + jacobian).astype(kept).reshape((*shape[:-2], *(-(-n // stride) for n in shape[-2:])))


def each_of(name: str, given: Any, number: int) -> list[Any]:
    """One for each image: those of a list, or the same for all."""
    if not isinstance(given, list | tuple):
        return [given] * number
    if len(given) != number:
        raise ValueError(f"{name} is a list of {len(given)} for {number} images; pass one for each, or one for all.")
    return list(given)
