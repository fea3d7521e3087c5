"""A frame through the compiled code: blocks of pixels on all cores, and another look at the difficult ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...records import Parameters
from ...statistics import Statistics, project
from ...threads import each, piece
from . import kernel
from .climb import moved
from .describe import CONVERGED, DOUBTFUL, NON_FINITE, ROUGH, ROWS, WIDE, rows
from .point import Point
from .priors import COPIES, FACTORS
from .ridge import follow, turned
from .scene import Scene

__all__ = ["Responses", "Summed", "pairs_of", "solve_frame"]

# pixels for which code is compiled: in small frames, which all cores shall share, and in large ones
BLOCKS = (512, 4096)
ACCELERATOR = (1 << 13, 1 << 18)  # the same where thousands of threads work side by side
# Newton steps of the first pass; of the others at first, and for pixels that need more; and of the last
FIRST, SOME, MOST, LAST = 3, 10, 60, 500
ALONE = 2048  # pixels up to which threads cost more than they bring
LOOKS = 1 << 16  # climbs from other starts that are in memory at once
STARTS = 8  # other starts of a pixel, at most
POLARISER = 0.9  # |D| from which on a free phase leaves the angle of the retarder about the same axis open
TURNS = [k * pi / 6 for k in range(1, 6)]  # about that axis; pi changes the sign of J


@dataclass(frozen=True)
class Responses:
    """Pixels that share the illumination: responses ``(pixels, 2, n)``, sigma ``(pixels)`` or ``(1)``."""

    response: np.ndarray
    sigma: np.ndarray
    shared: kernel.Shared
    balanced: bool

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return len(self.response)

    @property
    def dtype(self) -> np.dtype:
        """Real type of the results."""
        return np.zeros((), jax.dtypes.canonicalize_dtype(self.response.dtype)).real.dtype

    def run(self, scene: Scene, take: slice | np.ndarray, start: Any, given: int, iterations: int) -> tuple[Any, Any]:
        """Rows and flags of the pixels ``take``."""
        sigma = self.sigma if len(self.sigma) == 1 else self.sigma[take]
        return kernel.from_responses(
            scene, self.balanced, self.response[take], sigma, self.shared, start, given, iterations, self.dtype.type(1)
        )

    def reduced(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R and Y of pixels, complex ``(pixels, 2, 2)``."""
        sigma = np.broadcast_to(self.sigma if len(self.sigma) == 1 else self.sigma[index], len(index))[:, None, None]
        weight = self.shared.root_weight
        seen = np.where(weight > 0, self.response[index], 0) * weight
        return self.shared.root / sigma, seen @ self.shared.rows.conj().T / sigma

    @property
    def small(self) -> bool:
        """Whether code for statistics, compiled once for any number of states, is worth more than one pass less."""
        return not _large(self.pixels)

    def summed(self) -> Summed:
        """The same pixels by their statistics."""
        shared, sigma = self.shared, np.broadcast_to(self.sigma, self.pixels).astype(float)
        used, wide, count = shared.root_weight > 0, sigma[:, None, None], np.full(self.pixels, shared.count)
        complex_type = np.result_type(self.dtype, np.complex64)
        with np.errstate(invalid="ignore", over="ignore"):  # pixels that are not finite get no answer
            response, rest = project(np.where(used, self.response, 0) * shared.root_weight, shared.rows)
            rest = rest / sigma**2
            constant = shared.log_weight - shared.count * np.log(pi * sigma**2) - rest
            values = Statistics(shared.root / wide, response / wide, rest, constant, count)
            cast = (x.astype(complex_type if np.iscomplexobj(x) else self.dtype, copy=False) for x in values)
            return Summed(Statistics(*cast), self.balanced)


@dataclass(frozen=True)
class Summed:
    """Pixels with statistics of their own, ``(pixels, ...)``."""

    statistics: Statistics
    balanced: bool

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return len(self.statistics.residual)

    @property
    def dtype(self) -> np.dtype:
        """Real type of the results."""
        return np.zeros((), jax.dtypes.canonicalize_dtype(self.statistics.response.dtype)).real.dtype

    def run(self, scene: Scene, take: slice | np.ndarray, start: Any, given: int, iterations: int) -> tuple[Any, Any]:
        """Rows and flags of the pixels ``take``."""
        part = Statistics(*(x[take] for x in self.statistics))
        return kernel.from_statistics(scene, self.balanced, part, start, given, iterations, self.dtype.type(1))

    def reduced(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R and Y of pixels, complex ``(pixels, 2, 2)``."""
        return self.statistics.illumination[index], self.statistics.response[index]


Frame = Responses | Summed


def pairs_of(parameters: Parameters, dtype: np.dtype) -> np.ndarray:
    """(cosine, sine) of the five angles ``(10, pixels)``."""
    found = []
    for name, value, factor in zip(Parameters._fields, parameters, FACTORS, strict=True):
        x = np.asarray(value, float)
        angle = 0.5 * np.arcsin(np.clip(x, -1, 1)) if name == "diattenuation" else factor * x
        found += [np.cos(angle), np.sin(angle)]
    return np.stack(found).astype(dtype)


def _large(pixels: int) -> bool:
    """Whether a frame is cut into large pieces."""
    return pixels > piece(BLOCKS[1], ACCELERATOR[0])


def _fill(index: np.ndarray, size: int) -> np.ndarray:
    """As many indices as code is compiled for."""
    return np.concatenate([index, np.full(size - len(index), index[0])])


def _pass(
    scene: Scene, frame: Frame, index: np.ndarray | None, start: np.ndarray | None, given: int, iterations: int,
    out: np.ndarray, flags: np.ndarray, done: Callable[[int], Any],
) -> None:  # fmt: skip
    """Rows and flags of the pixels ``index`` (None: all), from a start or the closed form, into ``out``."""
    count = frame.pixels if index is None else len(index)
    large = _large(frame.pixels)
    size = piece(BLOCKS[large], ACCELERATOR[large])  # one for all passes: to compile takes seconds
    nothing = kernel.no_start(size, frame.dtype)

    def work(begin: int) -> None:
        end = min(begin + size, count)
        take: slice | np.ndarray
        if index is None and end - begin == size:
            take = slice(begin, end)
        else:
            own = np.arange(begin, end) if index is None else index[begin:end]
            take = _fill(own, size)
        begun = nothing
        if start is not None:
            begun = jnp.asarray(start[:, _fill(np.arange(begin, end), size)])
        found, bits = frame.run(scene, take, begun, given, iterations)
        out[:, begin:end] = np.asarray(found)[:, : end - begin]
        flags[begin:end] = np.asarray(bits)[: end - begin]
        done(end - begin)

    begins = range(0, count, size)
    if count > ALONE:
        each(work, begins)
    else:
        for begin in begins:
            work(begin)


def _alternatives(points: np.ndarray) -> list[np.ndarray]:
    """Starts where the data are ambiguous, from the points ``(10, pixels)`` found so far.

    First the other side of circularity +-pi/2, where an equivalent set has the better prior.
    """

    def changed(**pairs: tuple[Any, Any]) -> np.ndarray:
        new = points.copy()
        for name, (c, s) in pairs.items():
            i = Parameters._fields.index(name)
            length = np.hypot(c, s)  # a vector that is not a unit vector would be taken for a better fit
            new[2 * i], new[2 * i + 1] = c / length, s / length
        return new

    x1, y1, _, s2, x3, y3, a, b = points[2:10]
    edge = np.where(s2 < 0, -1.0, 1.0)
    return [
        changed(circularity=(-a, b)),
        changed(circularity=(0.999, 0.045)),
        changed(circularity=(0.999, 0.045), retardance_angle=(x3, -y3)),
        changed(diattenuation=(0.9997, 0.025)),
        changed(diattenuation_angle=(-x1, -y1)),
        changed(retardance=(0.05, edge)),
        changed(retardance=(0.05, -edge)),
        changed(diattenuation=(0.85, 0.527)),
    ]


def _copies(scene: Scene, points: np.ndarray) -> list[np.ndarray]:
    """The equivalent points whose priors differ, from the points ``(10, pixels)``."""
    pairs = Point(*points.reshape(5, 2, -1))
    found: dict[Any, np.ndarray] = {}
    for row, copy in zip(scene.copies, COPIES, strict=True):
        prior = tuple(None if t is None else t.transformed(*m) for t, m in zip(scene.prior, copy, strict=True))
        if row and prior not in found:
            found[prior] = np.concatenate([np.stack(pair) for pair in moved(copy, pairs)])
    return list(found.values())


def solve_frame(
    scene: Scene, frame: Frame, earlier: Parameters | None, done: Callable[[int], Any]
) -> tuple[np.ndarray, np.ndarray]:
    """The rows of the result ``(rows, pixels)`` and the flags of every pixel, the best maximum found."""
    pixels = frame.pixels
    out, flags = np.empty((rows(scene), pixels), frame.dtype), np.empty(pixels, np.int32)
    _pass(scene, frame, None, None, kernel.CLOSED_FORM, FIRST, out, flags, done)
    again = partial(_again, scene, frame, out, flags)
    again((flags & (CONVERGED | NON_FINITE)) == 0, lambda points, _: [points])
    again((flags & (DOUBTFUL | WIDE | NON_FINITE)) == DOUBTFUL, lambda points, _: _alternatives(points)[:1])
    again((flags & (WIDE | NON_FINITE)) == WIDE, lambda points, _: _alternatives(points))
    if len(scene.groups) > 2:  # priors that tell more than the two sides of the circularity apart
        ambiguous = (flags & NON_FINITE == 0) & (flags & (DOUBTFUL | WIDE) != 0)
        again(ambiguous, lambda points, _: _copies(scene, points), kernel.STAY)
    if earlier is not None:
        told = pairs_of(earlier, frame.dtype)
        finite = np.isfinite(told).all(axis=0)
        again(finite & ((flags & (WIDE | NON_FINITE)) == WIDE), lambda _, index: [told[:, index]])
    if scene.likelihood.free_phase and scene.free == (0, 1, 2, 3, 4):
        open_turn = ((flags & (WIDE | NON_FINITE)) == WIDE) & (np.abs(out[0]) > POLARISER)
        again(open_turn, partial(_turns, scene, frame))
    if frame.dtype == np.float64 and scene.free == (0, 1, 2, 3, 4):
        left = ((flags & CONVERGED) == 0) | ((flags & ROUGH) != 0)
        again(left & (flags & NON_FINITE == 0), partial(_along_ridges, scene, frame), kernel.STAY, 0)
    again((flags & (CONVERGED | NON_FINITE | ROUGH)) == 0, lambda points, _: [points], kernel.PATIENT, LAST)
    return out, flags


def _turns(scene: Scene, frame: Frame, points: np.ndarray, index: np.ndarray) -> list[np.ndarray]:
    """The same retarders turned about the axis of the diattenuator."""
    strength = np.sqrt(np.sum(np.abs(frame.reduced(index)[1]) ** 2, axis=(-1, -2)))
    return [turned(scene, points, alpha, strength).astype(frame.dtype) for alpha in TURNS]


def _along_ridges(scene: Scene, frame: Frame, points: np.ndarray, index: np.ndarray) -> list[np.ndarray]:
    """The best of the maxima that following the ridges leads to."""
    illumination, response = frame.reduced(index)
    illumination = np.broadcast_to(illumination, response.shape)
    best, top, _ = follow(scene, illumination, response, points)
    for begun in _turns(scene, frame, points, index) if scene.likelihood.free_phase else []:
        found, value, _ = follow(scene, illumination, response, begun)
        better = value > top + 1e-9
        best, top = np.where(better, found, best), np.where(better, value, top)
    return [best]


def _again(
    scene: Scene, frame: Frame, out: np.ndarray, flags: np.ndarray, which: np.ndarray,
    starts: Callable[[np.ndarray, np.ndarray], list[np.ndarray]], given: int = kernel.GIVEN, iterations: int = MOST,
) -> None:  # fmt: skip
    """Climb again from other starts, and keep what is better."""
    pixels = np.flatnonzero(which)
    step = LOOKS // STARTS
    for begin in range(0, len(pixels), step):
        index = pixels[begin : begin + step]
        begun = starts(pairs_of(Parameters(*out[ROWS["parameters"]][:, index]), frame.dtype), index)
        # all starts of all pixels side by side: a block is full, and waits for its slowest climb once
        new, bits = _climb(scene, frame, np.tile(index, len(begun)), np.concatenate(begun, axis=1), given, iterations)
        for found, its in zip(np.split(new, len(begun), axis=1), np.split(bits, len(begun)), strict=True):
            value, old = found[ROWS["log_posterior"]], out[ROWS["log_posterior"], index]
            # what is better by rounding only is worth no change, unless it settles a pixel
            slack, rounding = (1e-9, 1e-6) if out.dtype == np.float64 else (1e-4, 0.05)
            settled = (its & CONVERGED) > (flags[index] & CONVERGED)
            better = (its & NON_FINITE == 0) & ((value > old + slack) | ((value > old - rounding) & settled))
            out[:, index[better]], flags[index[better]] = found[:, better], its[better]


def _climb(
    scene: Scene, frame: Frame, index: np.ndarray, start: np.ndarray, given: int, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and flags of the pixels ``index`` from a start each."""
    new, bits = np.empty((rows(scene), len(index)), frame.dtype), np.empty(len(index), np.int32)

    def go(which: np.ndarray, start: np.ndarray, steps: int) -> None:
        found, its = np.empty((len(new), len(which)), new.dtype), np.empty(len(which), bits.dtype)
        _pass(scene, frame, index[which], start, given, steps, found, its, lambda _: None)
        new[:, which], bits[which] = found, its

    everything = np.arange(len(index))
    if given != kernel.GIVEN:
        go(everything, start, iterations)
        return new, bits
    go(everything, start, SOME)
    # a block takes as many steps as its slowest pixel: gather those that need more
    slow = np.flatnonzero((bits & (CONVERGED | NON_FINITE)) == 0)
    if len(slow):
        go(slow, pairs_of(Parameters(*new[ROWS["parameters"]][:, slow]), frame.dtype), iterations)
    return new, bits
