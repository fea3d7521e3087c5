"""What the pixels of a frame say about the phase at them: through the fast route, or for any model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..misalignment import TiltPlane
from ..model import Model
from ..records import Fit, Measurement, Parameters
from ..statistics import Statistics, least_squares_jones
from ..tilting import untilt
from . import tilt_general
from .fast import fast_scene, judge_states
from .fast.scene import Scene
from .fast.tilt import phase_responses
from .generic import prepare

__all__ = ["Pixels", "Said", "pixels_of"]

FIRST, NEXT = 6, 2  # Newton steps of a pixel from the closed form, and from where it was at another phase
GENERAL = 1024  # pixels that the general route is asked about before the last passes


class Said(NamedTuple):
    """Of the pixels ``chosen``: log density, its derivatives by the phase, at which phase, and the parameters' ones.

    ``follow`` is ``(5, pixels)``, per radian; ``points`` is where the pixels are, for the next call.
    """

    chosen: np.ndarray
    phase: np.ndarray
    value: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    follow: np.ndarray
    points: Any


class Pixels(ABC):
    """The usable pixels of one frame ``(rows, columns)``; ``basis`` are the terms of the phase there.

    ``alike`` says that their illuminations differ by a factor only.
    """

    def __init__(
        self, plane: TiltPlane, frame: tuple[int, int], good: np.ndarray, statistics: Statistics, alike: bool
    ) -> None:
        self.plane, self.frame, self.good, self.statistics, self.alike = plane, frame, good, statistics, alike
        left, right = plane.factors(frame)
        row, column = np.divmod(good, frame[1])
        self.basis = left[:, row] * right[:, column]
        self.reach = np.max(np.abs(left), axis=1) * np.max(np.abs(right), axis=1)

    @property
    def rounding(self) -> float:
        """Relative error of a sum of log densities."""
        return 10 * float(np.finfo(self.statistics.residual.dtype).eps)

    @property
    def count(self) -> int:
        """Number of pixels."""
        return len(self.good)

    def phase(self, coefficients: np.ndarray, index: np.ndarray | None = None) -> np.ndarray:
        """phi at the pixels."""
        return np.asarray(coefficients @ (self.basis if index is None else self.basis[:, index]))

    def spread(self, values: np.ndarray, empty: float = 0.0) -> np.ndarray:
        """Values ``(..., pixels)`` in the frame, ``(..., rows, columns)``."""
        shape = (*values.shape[:-1], self.frame[0] * self.frame[1])
        found = np.full(shape, empty, values.dtype)
        found[..., self.good] = values
        return found.reshape(*values.shape[:-1], *self.frame)

    def suggestions(self) -> np.ndarray:
        """Phasors of ``2 (phi - xi)``, from the least-squares matrices, ``(rows, columns)``."""
        if self.alike and self.count:  # up to a factor, which does not matter
            inverse = np.linalg.pinv(self.statistics.illumination[0].astype(complex))
            kind = self.statistics.response.dtype
            jones = (self.statistics.response.reshape(-1, 2) @ inverse.astype(kind)).reshape(-1, 2, 2)
        else:
            jones = least_squares_jones(self.statistics)
        size = np.sum(jones.real**2 + jones.imag**2, axis=(-1, -2))
        product = jones[:, 0, 1] * np.conj(jones[:, 1, 0])
        return self.spread(product / np.where(size > 0, size, 1))

    @abstractmethod
    def respond(self, coefficients: np.ndarray, previous: Said | None, index: np.ndarray | None) -> Said:
        """What the pixels ``index`` (None: all) say at a plane, each at its most probable parameters."""

    @abstractmethod
    def at_fit(self, coefficients: np.ndarray, fit: Fit) -> Said:
        """The same of all pixels, at the parameters of a fit."""


class FastPixels(Pixels):
    """Through the fast route."""

    def __init__(
        self, plane: TiltPlane, frame: tuple[int, int], good: np.ndarray, statistics: Statistics, alike: bool,
        scene: Scene, balanced: bool,
    ) -> None:  # fmt: skip
        super().__init__(plane, frame, good, statistics, alike)
        self.scene, self.balanced = scene, balanced

    def _ask(self, coefficients: np.ndarray, index: np.ndarray | None, start: Any, shift: Any, steps: int) -> Said:
        place = np.arange(self.count) if index is None else index
        own = self.statistics if index is None else Statistics(*(x[index] for x in self.statistics))
        phase = self.phase(coefficients, index)
        found = phase_responses(self.scene, self.balanced, own, phase, start, shift, steps)
        return _said(place, phase, found.value, found.slope, found.bend, found.parameters, found.points)

    def respond(self, coefficients: np.ndarray, previous: Said | None, index: np.ndarray | None) -> Said:
        if previous is None:
            return self._ask(coefficients, index, None, None, FIRST)
        shift = self.phase(coefficients, index) - previous.phase
        return self._ask(coefficients, index, previous.points, shift, NEXT)

    def at_fit(self, coefficients: np.ndarray, fit: Fit) -> Said:
        start = np.stack(list(_parameters(fit, self.good)))
        return self._ask(coefficients, None, start, None, 0)


class GeneralPixels(Pixels):
    """Any model, by a fit of the pixels and automatic differentiation."""

    def __init__(
        self, plane: TiltPlane, frame: tuple[int, int], good: np.ndarray, statistics: Statistics, alike: bool,
        model: Model, measurement: Measurement, fit: Callable[..., Fit],
    ) -> None:  # fmt: skip
        super().__init__(plane, frame, good, statistics, alike)
        self.model, self.measurement, self.fit = model, measurement, fit

    def respond(self, coefficients: np.ndarray, previous: Said | None, index: np.ndarray | None) -> Said:
        chosen = self.good if index is None else self.good[index]
        mask = np.zeros(self.frame[0] * self.frame[1], bool)
        mask[chosen] = True
        data = replace(self.measurement, mask=mask.reshape(self.measurement.shape))
        phase = self.plane.phase(coefficients, self.measurement.shape)
        found = self.fit(self.model, untilt(data, phase), None if previous is None else previous.points, False)
        return self._said(coefficients, index, found)

    def at_fit(self, coefficients: np.ndarray, fit: Fit) -> Said:
        return self._said(coefficients, None, fit)

    def _said(self, coefficients: np.ndarray, index: np.ndarray | None, fit: Fit) -> Said:
        place = np.arange(self.count) if index is None else index
        phase = self.phase(coefficients, index)
        parts = []
        for begin in range(0, len(place), GENERAL):
            part = place[begin : begin + GENERAL]
            own = Statistics(*(x[part] for x in self.statistics))
            parameters = _parameters(fit, self.good[part])
            parts.append(tilt_general.respond(self.model, parameters, phase[begin : begin + GENERAL], own))
        value, slope, bend, follow = (np.concatenate(x, axis=-1) for x in zip(*parts, strict=True))
        return _said(place, phase, value, slope, bend, follow, fit)


def _said(
    place: np.ndarray, phase: np.ndarray, value: np.ndarray, slope: np.ndarray, bend: np.ndarray, follow: np.ndarray,
    points: Any,
) -> Said:  # fmt: skip
    told = np.isfinite(value) & np.isfinite(slope) & np.isfinite(bend)
    value, slope, bend = (np.where(told, np.asarray(x, float), 0) for x in (value, slope, bend))
    # where two maxima of a pixel merge the derivatives are those of a point only: none speaks louder against a phase
    # than the most certain pixel speaks for one
    most = max(-bend.min(initial=0.0), 0.0)
    bend, slope = np.minimum(bend, most), np.clip(slope, -0.5 * most, 0.5 * most)
    return Said(place, phase, value, slope, bend, np.where(told, follow, 0), points)


def _parameters(fit: Fit, chosen: np.ndarray) -> Parameters:
    """Those of a fit, 0 where they drop out."""
    return Parameters(*(np.nan_to_num(np.asarray(x).reshape(-1)[chosen]) for x in fit.parameters))


def pixels_of(model: Model, measurement: Measurement, plane: TiltPlane, fit: Callable[..., Fit]) -> Pixels:
    """The pixels of a frame under a model without neighbours and with a known sigma."""
    prepared = prepare(model, measurement, False)
    good, shape = prepared.good, measurement.shape
    rows, columns = (1, 1, *shape)[-2:]
    statistics = prepared.pooled.own
    if len(good) < rows * columns:
        statistics = Statistics(*(x[good] for x in statistics))
    known, n = fast_scene(model), measurement.states
    alike = measurement.illumination.size == 2 * n and (measurement.weight is None or measurement.weight.size == n)
    usable, balanced = judge_states(statistics.illumination[: 1 if alike else None], statistics.residual.dtype)
    if known is not None and len(good) and np.all(usable):
        return FastPixels(plane, (rows, columns), good, statistics, alike, known, balanced)
    return GeneralPixels(plane, (rows, columns), good, statistics, alike, model, measurement, fit)
