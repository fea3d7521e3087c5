"""From images to mode amplitudes: the verb ``retrieve_fields``.

In: a :class:`fibre.Calibration` or a :class:`fibre.Recording` and a retrieval method. Out: amplitudes of the fibrelet
modes in both polarisations, their phases tied to the reference spot, with variances that the closure of the
illumination states has checked. Called by users and by the ``retrieve`` command.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import overload

import numpy as np
import scipy.linalg
from tqdm import tqdm

from fibre.fibrelets import locate_fibrelets, mode_amplitudes, mode_matrix
from fibre.interference import relative_phase
from fibre.records import (
    Calibration,
    CalibrationFields,
    Defocus,
    Fibrelets,
    Images,
    Recording,
    RecordingFields,
)
from fibre.retrieval.base import RetrievalMethod, retrieve
from polinfer.checks import one_of_types

__all__ = ["closure", "retrieve_fields"]


@dataclass(frozen=True)
class _Amplitudes:
    values: np.ndarray  # complex (captures, 2, m)
    variance: np.ndarray  # real (captures, 2, m)

    def relative_to(self, reference: np.ndarray) -> _Amplitudes:
        """Turn every capture so that the reference spot has the phase it has alone, and take its light away."""
        overlap = np.einsum("pk,cpk->c", np.conj(reference) * _reference_region(reference), self.values)
        turned = self.values * np.exp(-1j * np.angle(overlap))[:, None, None]
        return _Amplitudes(turned - reference, self.variance)


def _reference_region(reference: np.ndarray) -> np.ndarray:
    """Fibrelets that carry the reference spot: more than 3 % of its strongest one's power."""
    power = (np.abs(reference) ** 2).sum(0)
    return power > 0.03 * power.max()


@overload
def retrieve_fields(
    record: Calibration, method: RetrievalMethod, fibrelets: Fibrelets | None = None, progress: bool = False
) -> CalibrationFields: ...
@overload
def retrieve_fields(
    record: Recording, method: RetrievalMethod, fibrelets: Fibrelets | None = None, progress: bool = False
) -> RecordingFields: ...
def retrieve_fields(
    record: Calibration | Recording,
    method: RetrievalMethod,
    fibrelets: Fibrelets | None = None,
    progress: bool = False,
) -> CalibrationFields | RecordingFields:
    r"""Fields of every capture, in fibrelet modes, with variance.

    H comes from the defocused images by ``method``, V = (H^* V)/H^* from the phase-stepped ones, each projected on
    the modes by weighted least squares. The common phase that intensities cannot know is fixed by the reference spot,
    which every capture contains; its own light is then subtracted.

    The stated variance is that of the image noise times an ``inflation`` found from the data: n states of
    illumination span two dimensions, so n - 2 combinations of the fields must vanish (:func:`closure`), and their
    mean square in units of the stated variance measures all that the image noise does not explain. It is never taken
    below 1.

    Parameters
    ----------
    record: a Calibration or a Recording. method: for instance ``GerchbergSaxton()``. fibrelets: where the fibrelets
    are; a calibration finds them in its own images (None), a recording must be given its calibration's. progress:
    show a bar.

    Raises
    ------
    TypeError, ValueError: a record of another kind; a recording without ``fibrelets``.
    """
    one_of_types("record", record, (Calibration, Recording), "pass a Calibration or a Recording.")
    if isinstance(record, Calibration):
        if fibrelets is None:
            fibrelets = _find(record.images)
        reference = _retrieve(record.references, method, fibrelets, progress, "reference")
        mean_reference = reference.relative_to(reference.values[0]).values.mean(0) + reference.values[0]
        fields = _retrieve(record.images, method, fibrelets, progress, "calibration").relative_to(mean_reference)
        outside = ~_reference_region(mean_reference)
        inflation = _inflation(fields, record, outside)
        return CalibrationFields(
            fields.values,
            fields.variance * inflation,
            mean_reference,
            inflation,
            fibrelets,
            record.inputs,
            record.points,
            record.grid,
            record.registration,
        )
    if fibrelets is None:
        raise ValueError("fibrelets must be given for a Recording; pass calibration_fields.fibrelets.")
    reference = _retrieve(record.references, method, fibrelets, progress, "reference")
    mean_reference = reference.relative_to(reference.values[0]).values.mean(0) + reference.values[0]
    fields = _retrieve(record.images, method, fibrelets, progress, "sample").relative_to(mean_reference)
    blank = _retrieve(record.blank, method, fibrelets, progress, "blank").relative_to(mean_reference)
    outside = ~_reference_region(mean_reference)
    ratios = [
        closure(part.values[..., outside], part.variance[..., outside], record.illumination) for part in (fields, blank)
    ]
    inflation = _mean_ratio(ratios)
    return RecordingFields(
        fields.values,
        fields.variance * inflation,
        blank.values,
        blank.variance * inflation,
        inflation,
        fibrelets,
        record.illumination,
    )


def _find(images: Images) -> Fibrelets:
    """Fibrelets in the sum of all interference images: every capture lights others, and incoherent sums are even."""
    total = np.zeros(images.frame)
    for capture in range(images.captures):
        frames = np.asarray(images.radiance[capture])[len(images.diversity) :].mean(0)
        total += frames / max(frames.max(), 1e-300)
    return locate_fibrelets(total, images.pixel_size)


def _retrieve(
    images: Images, method: RetrievalMethod, fibrelets: Fibrelets, progress: bool, name: str, batch: int = 8
) -> _Amplitudes:
    planes = len(images.diversity)
    modes = mode_matrix(fibrelets, images.frame, images.pixel_size)
    values = np.empty((images.captures, 2, len(fibrelets.centres)), complex)
    variance = np.empty(values.shape)
    bar = tqdm(total=images.captures, desc=f"fields of {name}", unit="capture", disable=not progress)
    for start in range(0, images.captures, batch):
        part = range(start, min(start + batch, images.captures))
        radiance = np.stack([np.asarray(images.radiance[c]) for c in part])
        noise = np.stack([np.asarray(images.variance[c]) for c in part])
        saturated = np.stack([np.asarray(images.saturated[c]) for c in part])
        noise = np.where(saturated, np.inf, noise)
        diversity = Defocus(
            radiance[:, :planes], images.diversity, images.wavelength, images.pixel_size, noise[:, :planes]
        )
        retrieved = retrieve(diversity, method, batch=batch)
        fringes = relative_phase(radiance[:, planes:], images.steps, 1 / noise[:, planes:])
        for i, capture in enumerate(part):
            h, h_variance = retrieved.field[i].astype(complex), retrieved.variance[i].astype(float)
            # a pixel is a sample of the field, a mode an integral over it: power per pixel area
            scale = 1 / images.pixel_size**2
            power = float((np.abs(h) ** 2).sum()) / scale
            values[capture, 0], variance[capture, 0] = mode_amplitudes(h, h_variance, modes, power)
            intensity = np.abs(h) ** 2
            v_intensity = np.maximum(2 * fringes.mean[i] - intensity, 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                v = fringes.product[i] / np.conj(h)
                v_variance = (fringes.variance[i] + v_intensity * h_variance) / intensity
            v_variance = np.where(np.isfinite(v) & np.isfinite(v_variance), v_variance, np.inf)
            values[capture, 1], variance[capture, 1] = mode_amplitudes(v, v_variance, modes, power)
            bar.update()
    bar.close()
    return _Amplitudes(values, variance)


def closure(fields: np.ndarray, variance: np.ndarray, states: np.ndarray) -> np.ndarray:
    r"""Squared closure errors of n fields made by known illumination states, in units of their stated variance.

    n fields that depend linearly on states U (2, n) obey :math:`\sum_k c_k y_k = 0` for every c with U c = 0; there
    are n - 2 such c. Returns :math:`|\sum c_k y_k|^2 / \sum |c_k|^2 \mathrm{var}_k`, real (n - 2, ...), of mean 1
    when the variances are true. ``fields``, ``variance``: (n, ...).

    >>> states = np.array([[1, 1, 1], [1, 1j, -1]])
    >>> fields = np.einsum("an,a->n", states, [0.3, 2j])[:, None]
    >>> bool(closure(fields, np.ones((3, 1)), states).max() < 1e-25)
    True
    """
    null = scipy.linalg.null_space(np.asarray(states))
    error = np.einsum("kc,k...->c...", null, fields)
    expected = np.einsum("kc,k...->c...", np.abs(null) ** 2, variance)
    return np.abs(error) ** 2 / expected


def _mean_ratio(ratios: list[np.ndarray]) -> float:
    """Mean closure error, never below 1: noise is not believed to be smaller than the image noise."""
    flat = np.concatenate([r.ravel() for r in ratios]) if ratios else np.zeros(0)
    return max(1.0, float(flat.mean())) if flat.size else 1.0


def _inflation(fields: _Amplitudes, calibration: Calibration, outside: np.ndarray) -> float:
    """Inflation from the closure of captures that light the same points in different states."""
    inputs = calibration.inputs.tocsc()
    count = len(calibration.points)
    groups: dict[tuple[int, ...], list[int]] = {}
    for capture in range(inputs.shape[1]):
        rows = inputs.indices[inputs.indptr[capture] : inputs.indptr[capture + 1]]
        groups.setdefault(tuple(sorted(set(rows % count))), []).append(capture)
    ratios = []
    for points, captures in groups.items():
        if len(captures) < 3:
            continue
        states = inputs[[points[0], points[0] + count], :][:, captures].toarray()
        chosen = np.array(captures)
        ratios.append(closure(fields.values[chosen][..., outside], fields.variance[chosen][..., outside], states))
    return _mean_ratio(ratios)
