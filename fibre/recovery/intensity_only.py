"""A calibration without phase retrieval: the phases of all captures from the matrix that they share.

In: a :class:`fibre.Calibration` of random patterns. Out: :class:`fibre.Inverse`, whose calibration fields are those
that the found matrix gives. Called by users through ``recover``.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import scipy.sparse
import scipy.spatial
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from fibre.coupling import Profile, positions_on_camera, profile_of_patterns
from fibre.fibrelets import lattice_pitch, mode_matrix, reference_region
from fibre.fields import fibrelets_of, pattern_groups, retrieve_fields
from fibre.records import Calibration, CalibrationFields, Fibrelets, Images, Inverse
from fibre.recovery.base import RecoveryMethod
from fibre.recovery.forward_inverse import ForwardInverse
from fibre.recovery.intensity_rows import Algorithm, rows_from_intensities
from fibre.retrieval.base import RetrievalMethod
from fibre.retrieval.modal import Modal
from polinfer.checks import integer, one_of_types

__all__ = ["IntensityOnly"]

FOCUS = 2e-6  # metres: an image nearer to the focus than this is in focus
CORE = 0.6  # of the mode's radius: pixels further out hold a neighbour's light too
REACH = 1e-5  # of the coupling's peak: fainter points are left out
MODEL = 0.01  # relative error of intensities that is not in the images' noise: shapes of modes, focus, pixels
UNKNOWN = 0.01  # relative variance of a typical row beyond which it is not known
SYNCHRONISE = 20  # times between the phases of fibrelets and those of captures
FAINT = 1e-4  # of a neighbour's light: nothing


@dataclass(frozen=True)
class IntensityOnly(RecoveryMethod):
    r"""The inverse from intensities of fibrelets alone, but for a few captures that are retrieved.

    Intensities of the images in focus say, for fibrelet k and capture c with the known inputs x,

    .. math:: |a_k x_c + r_k|^2, \quad \tfrac12 |(a_k + e^{i\phi_s} b_k) x_c + r_k + e^{i\phi_s} s_k|^2

    for its rows a, b of A in H and V and the reference spot's constant light r, s: one problem of phase retrieval for
    each fibrelet (:func:`fibre.rows_from_intensities`), which all captures share, instead of one for each capture. What
    it leaves open is a phase of each fibrelet, the same in all captures: ``tie`` patterns are retrieved by
    ``retrieval`` and tell it. The fields that the rows give then go the way of :class:`fibre.ForwardInverse`.

    It needs random patterns (:class:`acquisition.PatternPlan`): where no two points are lit within reach of one
    fibrelet, no intensity tells their relative phase.

    Parameters
    ----------
    algorithm: of :func:`fibre.rows_from_intensities`, but for "spectral". retrieval: None: ``Modal`` of the fibrelets.
    fibrelets: where they are; None: found in the images. tie: patterns that are retrieved, >= 1, chosen to light all
    fibrelets. inverse: how the fields are inverted; None: ``ForwardInverse()``.

    Raises ValueError where no image is in focus, or where the inputs do not tell the rows.

    Source: the sources of :func:`fibre.rows_from_intensities`, used for a calibration as in Gordon et al. (2018), 8.
    """

    algorithm: Literal["variational", "message_passing"] = "variational"
    retrieval: RetrievalMethod | None = None
    fibrelets: Fibrelets | None = None
    tie: int = 4
    inverse: ForwardInverse | None = None

    takes: ClassVar[type] = Calibration

    def __post_init__(self) -> None:
        # the spectral start alone says nothing of its errors
        if self.algorithm not in ("variational", "message_passing"):
            raise ValueError(f"algorithm must be 'variational' or 'message_passing', got {self.algorithm!r}.")
        integer("tie", self.tie, low=1)
        if self.inverse is not None:
            one_of_types("inverse", self.inverse, (ForwardInverse,), "pass ForwardInverse(...).")

    def solve(
        self, fields: Calibration, progress: bool, folder: str | Path | None = None, client: Any = None
    ) -> Inverse:
        """See :meth:`RecoveryMethod.solve`; the record is a Calibration."""
        return (self.inverse or ForwardInverse()).solve(self.fields(fields, progress), progress, folder, client)

    def fields(self, calibration: Calibration, progress: bool = False) -> CalibrationFields:
        """Fields of every capture as the rows give them; the variance is that of what its intensities say."""
        fibrelets = fibrelets_of(calibration) if self.fibrelets is None else self.fibrelets
        optics = _Optics.of(fibrelets, calibration.images)
        seen, alone = optics.intensities(calibration.images), optics.intensities(calibration.references)
        work = _Work.of(calibration, fibrelets, optics, seen, alone, self.algorithm)
        chosen = self._chosen(calibration, seen)
        part = replace(
            calibration,
            images=_some(calibration.images, chosen),
            inputs=scipy.sparse.csr_array(calibration.inputs.tocsc()[:, chosen]),
        )
        method = Modal(fibrelets) if self.retrieval is None else self.retrieval
        retrieved = retrieve_fields(part, method, fibrelets, progress)
        found = work.rows(None, "rows from intensities", progress).tied(retrieved, chosen)
        found = work.rows(found, "rows without neighbours' light", progress).tied(retrieved, chosen)
        status = np.zeros(calibration.images.captures, np.uint8)
        if retrieved.status is not None:
            status[chosen] = retrieved.status
        # where nothing is known the field is 0, with the variance of the strongest one
        variance = np.where(np.isfinite(found.variance), found.variance, np.abs(found.values).max() ** 2)
        return CalibrationFields(
            found.values, variance, retrieved.reference, 1.0, 0.0, fibrelets, calibration.inputs,
            calibration.points, calibration.grid, calibration.registration, status,
        )  # fmt: skip

    def _chosen(self, calibration: Calibration, seen: _Seen) -> list[int]:
        """Captures of ``tie`` patterns that together light every fibrelet, in order."""
        groups = [captures for captures, _ in pattern_groups(calibration)]
        light = np.stack([seen.values[captures].mean((0, 1)) for captures in groups])
        share = light / np.maximum(light.mean(0), 1e-300)
        told = np.zeros(share.shape[1])
        chosen: list[int] = []
        for _ in range(min(self.tie, len(groups))):
            # the logarithm asks for light on fibrelets that are still dark
            gains = np.log(told + share + 1e-3).sum(1)
            gains[chosen] = -np.inf
            chosen.append(int(np.argmax(gains)))
            told += share[chosen[-1]]
        return sorted(int(c) for pattern in chosen for c in groups[pattern])


class _Fields(NamedTuple):
    """values: complex (captures, 2, m); variance; constant: the reference's part, complex (2, m); chi_square: (m,)."""

    values: np.ndarray
    variance: np.ndarray
    constant: np.ndarray
    chi_square: np.ndarray

    def tied(self, retrieved: CalibrationFields, chosen: list[int]) -> _Fields:
        """Every fibrelet turned to the phase that it has in the retrieved captures, whose pistons are their own."""
        products = np.conj(self.values[chosen]) * retrieved.fields / retrieved.variance
        products = products.sum(1)
        piston = np.ones(len(chosen), complex)
        for _ in range(SYNCHRONISE):
            turn = np.exp(1j * np.angle(piston.conj() @ products))
            piston = np.exp(1j * np.angle(products @ turn.conj()))
        return self._replace(values=self.values * turn, constant=self.constant * turn)


class _Seen(NamedTuple):
    """Intensities of fibrelets and their variance, (captures, 1 + k, m): H in focus, then the phase steps."""

    values: np.ndarray
    variance: np.ndarray


class _Optics(NamedTuple):
    """How pixels tell the power of a fibrelet.

    core: sparse (m, pixels), squared modes near their centres. leak: sparse (m, m), what twice the product of a
    fibrelet's own amplitude and a neighbour's adds to the power that is found; no diagonal. focus: which image.
    """

    core: scipy.sparse.csr_array
    leak: scipy.sparse.csr_array
    focus: int

    @classmethod
    def of(cls, fibrelets: Fibrelets, images: Images) -> _Optics:
        """Of one camera; raises ValueError where it has no image in focus."""
        focus = int(np.argmin(np.abs(images.diversity)))
        if abs(images.diversity[focus]) > FOCUS:
            raise ValueError(
                f"calibration has no image in focus: the nearest is {images.diversity[focus]:g} m away; "
                "take one with a distance of 0 among the diversity."
            )
        modes = mode_matrix(fibrelets, images.frame, images.pixel_size)
        peak = np.sqrt(2 / np.pi) * images.pixel_size / fibrelets.mode_radius
        near = modes.copy()
        near.data = np.where(near.data >= np.exp(-(CORE**2)) * peak[near.indices], near.data, 0)
        near.eliminate_zeros()
        fourth = np.asarray(near.power(4).sum(axis=0)).ravel()
        leak = scipy.sparse.diags_array(1 / fourth) @ (near.power(3).T @ modes)
        leak = scipy.sparse.csr_array(leak - scipy.sparse.diags_array(leak.diagonal()))
        leak.data = np.where(np.abs(leak.data) > FAINT, leak.data, 0)
        leak.eliminate_zeros()
        return cls(scipy.sparse.csr_array(near.power(2).T), leak, focus)

    def intensities(self, images: Images) -> _Seen:
        """Powers by least squares over the pixels near each centre."""
        squares = self.core.power(2)
        values, variance = [], []
        views = [self.focus, *range(len(images.diversity), len(images.diversity) + len(images.steps))]
        for capture in range(images.captures):
            frames, noise, saturated = (
                np.asarray(part[capture])[views].reshape(len(views), -1).astype(float)
                for part in (images.radiance, images.variance, images.saturated)
            )
            usable = (saturated == 0) & np.isfinite(noise)
            weight = squares @ usable.T.astype(float)
            safe = np.maximum(weight, 1e-300)
            values.append(((self.core @ np.where(usable, frames, 0).T) / safe).T)
            spread = (squares @ np.where(usable, noise, 0).T) / safe**2
            # most of the weight is in the middle: without it little is known
            variance.append(np.where(weight > 0.3 * np.asarray(squares.sum(axis=1))[:, None], spread, np.inf).T)
        return _Seen(np.stack(values), np.stack(variance))

    def crosstalk(self, fields: np.ndarray) -> np.ndarray:
        """What neighbours add to the power of each fibrelet, (m, ...), in fields (m, ...)."""
        return np.asarray(2 * (fields.conj() * (self.leak @ fields)).real)


class _Work(NamedTuple):
    """Everything that the rows of a fibrelet need; see :meth:`rows`."""

    optics: _Optics
    seen: _Seen
    alone: _Seen
    inputs: np.ndarray
    positions: np.ndarray
    centres: np.ndarray
    usable: np.ndarray
    profile: Profile
    steps: np.ndarray
    algorithm: Algorithm

    @classmethod
    def of(
        cls, calibration: Calibration, fibrelets: Fibrelets, optics: _Optics, seen: _Seen, alone: _Seen,
        algorithm: Algorithm,
    ) -> _Work:  # fmt: skip
        """With the coupling profile of the inputs."""
        power = alone.values[:, 1:].mean((0, 1))
        usable, positions = ~reference_region(power), positions_on_camera(calibration)
        pitch = lattice_pitch(fibrelets.centres)
        # the mean over the steps is half of the power of H and V together
        mean = seen.values[:, 1:].mean(1) - power
        profile = profile_of_patterns(fibrelets.centres[usable], positions, calibration.inputs, mean[:, usable], pitch)
        return cls(optics, seen, alone, calibration.inputs.toarray(), positions, fibrelets.centres, usable, profile,
                   calibration.images.steps, algorithm)  # fmt: skip

    def rows(self, before: _Fields | None, title: str, progress: bool) -> _Fields:
        """Rows of every usable fibrelet, the neighbours' light taken off where the fields ``before`` tell it."""
        m = len(self.centres)
        values, excess = self.seen.values.copy(), self.unexplained(before)
        if before is not None:
            both = before.values + before.constant
            for view, mixed in enumerate(self.views(both)):
                values[:, view] -= self.optics.crosstalk(mixed.T).T
        variance = self.seen.variance + excess
        fields, spread = np.zeros((len(values), 2, m), complex), np.full((len(values), 2, m), np.inf)
        constant, chi_square, unknown = np.zeros((2, m), complex), np.full(m, np.nan), np.full(m, np.nan)
        chosen = np.flatnonzero(self.usable)
        with (
            threadpool_limits(1, user_api="blas"),
            ThreadPoolExecutor(os.cpu_count()) as pool,
            tqdm(total=len(chosen), desc=title, unit="fibrelet", disable=not progress) as bar,
        ):
            tasks = pool.map(lambda k: self.fibrelet(k, values[:, :, k], variance[:, :, k]), chosen)
            for k, part in zip(chosen, tasks, strict=True):
                fields[:, :, k], spread[:, :, k], constant[:, k], chi_square[k], unknown[k] = part
                bar.update()
        if not np.nanmedian(unknown) < UNKNOWN:
            raise ValueError(
                "calibration does not tell the rows of the matrix: its intensities leave a relative variance of "
                f"{np.nanmedian(unknown):.2g} in that of a typical fibrelet. Light several points within reach of each "
                "at the same time, as a PatternPlan does, and take five times as many images as there are unknowns."
            )
        return _Fields(fields, spread, constant, chi_square)

    def views(self, fields: np.ndarray) -> list[np.ndarray]:
        """What each view shows of fields (captures, 2, m): complex (captures, m)."""
        mixed = [(fields[:, 0] + np.exp(1j * step) * fields[:, 1]) / np.sqrt(2) for step in self.steps]
        return [fields[:, 0], *mixed]

    def unexplained(self, before: _Fields | None) -> np.ndarray:
        """Variance of intensities by shapes that are not quite the modes', and by neighbours' light of unknown phase, a
        hundredth of which is left where it was taken off."""
        squared = self.optics.leak.power(2)
        powers = np.maximum(self.seen.values, 0)
        cross = np.stack([2 * powers[:, v] * (squared @ powers[:, v].T).T for v in range(powers.shape[1])], 1)
        return (cross if before is None else 0.01 * cross) + (MODEL * powers) ** 2

    def fibrelet(
        self, k: int, values: np.ndarray, variance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, float]:
        """Fields (captures, 2), their variance, the constant (2,), reduced chi-square, relative variance of the row."""
        away = np.hypot(*(self.positions - self.centres[k]).T)
        near = np.flatnonzero(away <= self.profile.reach(REACH))
        count, captures = len(self.positions), len(values)
        if len(near) == 0:
            return (
                np.zeros((captures, 2), complex),
                np.full((captures, 2), np.inf),
                np.zeros(2, complex),
                np.nan,
                np.nan,
            )
        x = np.concatenate([self.inputs[near], self.inputs[near + count], np.ones((1, captures))])
        n = len(x)
        x = np.concatenate([x, np.eye(n)[:, -1:]], axis=1)  # the reference alone, last
        views = [np.concatenate([x, 0 * x])]
        views += [np.concatenate([x, np.exp(1j * step) * x]) / np.sqrt(2) for step in self.steps]
        lone, lone_spread = self.alone.values[:, :, k].mean(0), self.alone.variance[:, :, k].mean(0)
        lone_spread = lone_spread / len(self.alone.values)
        intensities = np.concatenate([values, lone[None]]).T.ravel()
        spread = np.concatenate([variance, lone_spread[None]]).T.ravel()
        floor = np.sqrt(lone_spread.min()) if np.isfinite(lone_spread.min()) else 0.0
        tau = self.profile(away[near])
        light = [max(lone[0], floor), max(2 * lone[1:].mean() - lone[0], floor)]
        prior = np.concatenate([tau, tau, light[:1], tau, tau, light[1:]])
        found = rows_from_intensities(
            np.concatenate(views, axis=1), intensities[None], np.maximum(spread, 1e-300)[None], prior, self.algorithm
        )
        a, b = found.values[0, :n], found.values[0, n:]
        fields = np.stack([a[:-1] @ x[:-1, :-1], b[:-1] @ x[:-1, :-1]], axis=1)
        noise = variance / (2 * np.maximum(values, np.sqrt(variance)))
        # an intensity says half of what a field does: nothing of the phase
        told = 1 / (2 * noise)
        worse = max(float(found.chi_square[0]), 1.0)
        steps = told[:, 1:].sum(1) / 2
        known = np.stack([told[:, 0] + steps, steps], axis=1)
        stated = worse / np.maximum(known, 1e-300)
        power = float((np.abs(found.values) ** 2).sum())
        unknown = float(found.variance.sum()) / max(power, 1e-300)
        return fields, stated, np.array([a[-1], b[-1]]), float(found.chi_square[0]), unknown


def _some(images: Images, chosen: list[int]) -> Images:
    """Some of the captures, in memory."""
    radiance, variance, saturated = (
        np.stack([np.asarray(part[c]) for c in chosen]) for part in (images.radiance, images.variance, images.saturated)
    )
    return replace(images, radiance=radiance, variance=variance, saturated=saturated, times=images.times[chosen])
