"""Joint distributions of several angles in sliding windows."""

from __future__ import annotations

from functools import reduce

import numpy as np

from .joint import Joint, score_matching, terms
from .quadrature import joint_entropy
from .windows import Sweep, sweep

__all__ = ["joint_windows"]


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
        parameters = score_matching(self.terms, means)
        found = joint_entropy(self.model, parameters, np.abs(np.array(directions)).T)
        entropy[enough] = found + _correction(count, d, self.model.degrees(d))
        begin = (rows.start + first) // step
        self.out[begin : begin + shape[0]] = entropy.reshape(shape)


def _correction(count: np.ndarray, angles: int, degrees: int) -> np.ndarray:
    """What entropies of few pixels lack on average: that of a Gaussian, exactly, and half of each further parameter.

    The log determinant of a covariance of n draws in d dimensions loses ``log(n / 2) - digamma((n - i) / 2)`` for each i
    from 1 to d.
    """
    from scipy.special import digamma

    count = np.maximum(count, angles + 1)
    gaussian = sum(np.log(0.5 * count) - digamma(0.5 * (count - i)) for i in range(1, angles + 1))
    further = degrees - angles * (angles + 3) // 2
    return 0.5 * np.asarray(gaussian) + 0.5 * further / count


def joint_windows(
    angles: list[np.ndarray], noise: list[np.ndarray] | None, used: np.ndarray, size: int, model: Joint, fewest: int,
    stride: int,
) -> np.ndarray:  # fmt: skip
    """Entropies of the joint distributions of angles, period 2 pi, in the windows of frames ``(frames, y, x)``.

    ``used``: which pixels count, all angles being finite there. Returns every ``stride``-th row and column.
    """
    frames, rows, columns = used.shape
    result = np.full((frames, -(-rows // stride), -(-columns // stride)), np.nan)
    for i in range(frames):
        one = None if noise is None else [x[i] for x in noise]
        frame = _JointFrame([x[i] for x in angles], one, used[i], model, fewest, stride, result[i])
        sweep(frame, (rows, columns), size, np.dtype(np.float64))
    return result
