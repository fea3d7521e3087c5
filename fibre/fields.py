"""From images to mode amplitudes: the verb ``retrieve_fields``.

In: a :class:`fibre.Calibration` or a :class:`fibre.Recording` and a retrieval method. Out: amplitudes of the fibrelet
modes in both polarisations, their phases tied to the reference spot, with variances that the closure of the
illumination states has checked. Called by users and by the ``retrieve`` command.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, overload

import numpy as np
import scipy.spatial
from tqdm import tqdm

from fibre.amplitudes import CaptureAmplitudes, closure_outside, mean_reference_of
from fibre.closure import noise_of_groups, noise_scale
from fibre.coupling import positions_on_camera
from fibre.drift import Drift, track_drift
from fibre.fibrelets import LocalPower, ModeBasis, lattice_pitch, locate_fibrelets, mode_matrix
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
from fibre.retrieval.base import ModeMethod, RetrievalMethod, retrieve
from polinfer.checks import one_of_types
from polinfer.kept import Kept, fingerprint

__all__ = ["fibrelets_of", "pattern_groups", "retrieve_fields", "retrieve_sample"]

APART = 5.0  # fibrelets between neighbouring spots, from which on the light of each is closed by itself


@overload
def retrieve_fields(
    record: Calibration,
    method: RetrievalMethod,
    fibrelets: Fibrelets | CalibrationFields | None = None,
    progress: bool = False,
    drift: Drift | Literal["track"] | None = None,
    folder: str | Path | None = None,
) -> CalibrationFields: ...
@overload
def retrieve_fields(
    record: Recording,
    method: RetrievalMethod,
    fibrelets: Fibrelets | CalibrationFields | None = None,
    progress: bool = False,
    drift: Drift | Literal["track"] | None = None,
    folder: str | Path | None = None,
) -> RecordingFields: ...
def retrieve_fields(
    record: Calibration | Recording,
    method: RetrievalMethod,
    fibrelets: Fibrelets | CalibrationFields | None = None,
    progress: bool = False,
    drift: Drift | Literal["track"] | None = None,
    folder: str | Path | None = None,
) -> CalibrationFields | RecordingFields:
    r"""Fields of every capture, in fibrelet modes, with variance.

    H comes from the defocused images by ``method``, V = (H^* V)/H^* from the phase-stepped ones, each projected on
    the modes by weighted least squares. The common phase that intensities cannot know is fixed by the reference spot,
    which every capture contains, and then, between the states of one scene, by their closure
    (:func:`fibre.closure.closure_phases`): the spot lights a dozen fibrelets, the scene hundreds. Where the spots of a
    calibration are five fibrelets or more apart, no plane may show how their light interferes: then the light of every
    spot is closed by itself, which leaves one unknown phase a point, the same in all states and both polarisations, so
    that it drops out of what is measured against a blank. The reference spot's own light
    is then subtracted. The spot must stand clear of the sample: light of the sample on the spot's fibrelets turns the
    phase of its capture.

    The variance is that of the image noise times an ``inflation``, one of H and one of V, plus a ``relative_error``
    squared times the power plus, in a calibration, a ``stray`` squared times the mean power of the capture, all found
    from the data: n states of illumination span two dimensions, so n - 2 combinations of the fields must vanish
    (:func:`fibre.closure.closure_errors`), and how far they do not measures all that the image noise does not explain.
    Captures of a calibration whose states close far worse than the others' have failed: they get the variance that they
    show (:func:`fibre.closure.noise_of_groups`). With two states there is no such check, and the image noise is all
    that is stated.

    Parameters
    ----------
    record: a Calibration or a Recording. method: for instance ``GerchbergSaxton()``. fibrelets: where the fibrelets
    are; a calibration finds them in its own images (None), a recording must be given its calibration's, or the
    CalibrationFields themselves. progress:
    show a bar. drift: piston and tilt against time (:func:`fibre.track_drift`), taken out of every capture and
    reference at its time; with two states its uncertainty is counted in the variance, with more their closure measures
    what is left of it. The reference spot sets the piston in any case, so that it is
    the tilt that this is for. "track": followed through the record's own references, of a recording against the
    reference of its calibration, which ``fibrelets`` must then be; what it does between two states of one scene their
    closure tells (:func:`fibre.closure.closure_tilts`). None: the fibre holds still but for pistons.
    folder: where the amplitudes of finished captures are kept (made if absent), so that the same call goes on where it
    was interrupted; None: nowhere. The folder belongs to one method, set of fibrelets and record, which is known by its
    shape, times and settings and by the images of its first and last capture.

    Raises
    ------
    TypeError, ValueError: a record of another kind; a recording without ``fibrelets``; a folder of another call.
    """
    one_of_types("record", record, (Calibration, Recording), "pass a Calibration or a Recording.")
    if drift is not None and drift != "track":
        one_of_types("drift", drift, (Drift,), 'make one with track_drift, or pass "track".')
    anchor, tracked = None, isinstance(drift, str)
    if isinstance(fibrelets, CalibrationFields):
        anchor = fibrelets.reference
        fibrelets = fibrelets.fibrelets
    if isinstance(record, Calibration):
        if fibrelets is None:
            fibrelets = fibrelets_of(record)
        groups = pattern_groups(record)
        run, reference = _Run(method, fibrelets, progress, None, folder, _closes(groups)).following(
            drift, record.references, anchor
        )
        mean_reference = mean_reference_of(reference)
        fields = run.amplitudes(record.images, "calibration").in_phase_with(mean_reference)
        tilting = fibrelets if tracked else None
        apart = _spots_apart(record, fibrelets)
        for chosen, states in groups:
            part, owner = fields.of(chosen), apart(chosen)
            if owner is None or tilting is not None:
                part = part.closed(mean_reference, states, tilting)
            if owner is not None:
                part = part.closed_apart(mean_reference, states, owner)
            fields.values[chosen] = part.values
        errors = [closure_outside(fields.of(chosen), mean_reference, states) for chosen, states in groups]
        noise, factors = noise_of_groups(errors, by_polarisation=True)
        variance = fields.stated(noise)
        for (chosen, _), factor in zip(groups, factors, strict=True):
            variance[chosen] *= factor
        return CalibrationFields(
            fields.values - mean_reference,
            variance,
            mean_reference,
            noise.inflation,
            noise.relative_error,
            fibrelets,
            record.inputs,
            record.points,
            record.grid,
            record.registration,
            fields.status,
            noise.stray,
        )
    if fibrelets is None:
        raise ValueError("fibrelets must be given for a Recording; pass calibration_fields.fibrelets.")
    if tracked and anchor is None:
        raise ValueError("fibrelets must be the CalibrationFields where the drift of a Recording is to be tracked.")
    run, reference = _Run(method, fibrelets, progress, None, folder, record.illumination.shape[1] > 2).following(
        drift, record.references, anchor
    )
    mean_reference = mean_reference_of(reference)
    fields = run.amplitudes(record.images, "sample").in_phase_with(mean_reference)
    blank = run.amplitudes(record.blank, "blank").in_phase_with(mean_reference)
    tilting = fibrelets if tracked else None
    states = record.illumination
    fields, blank = (
        part.closed(mean_reference, states, tilting).closed_over_the_facet(mean_reference, states, fibrelets)
        for part in (fields, blank)
    )
    errors = [closure_outside(part, mean_reference, states) for part in (fields, blank)]
    # a sample's light is everywhere: what strays cannot be told from what is in proportion
    noise = noise_scale(np.concatenate(errors, axis=-1)[:3], by_polarisation=True)
    # what is wrong in proportion to the light is so in proportion to all of it, the reference spot's included
    return RecordingFields(
        fields.values - mean_reference,
        fields.stated(noise),
        blank.values - mean_reference,
        blank.stated(noise),
        noise.inflation,
        noise.relative_error,
        fibrelets,
        record.illumination,
        fields.status,
        blank.status,
    )


def retrieve_sample(
    images: Images, method: RetrievalMethod, calibration_fields: CalibrationFields, before: RecordingFields
) -> RecordingFields:
    """Fields of the next frame of a series: the sample alone is retrieved, its blank is that of ``before``.

    As :func:`retrieve_fields` of a recording, with the reference spot of the calibration for that of the recording, and
    the noise from the closure of the sample's states alone. A fibre that has moved since needs a new recording; the
    piston between the frames and the blank is not known.

    images: n captures, in the states of ``before``. method: for instance ``Modal(calibration_fields.fibrelets)``.

    Raises TypeError for other records, ValueError for another number of captures.
    """
    one_of_types("images", images, (Images,), "pass the captured Images.")
    one_of_types("calibration_fields", calibration_fields, (CalibrationFields,), "make them with retrieve_fields.")
    one_of_types("before", before, (RecordingFields,), "make them with retrieve_fields(recording).")
    states = before.illumination
    if images.captures != states.shape[1]:
        raise ValueError(f"images must have one capture per state ({states.shape[1]}), got {images.captures}.")
    reference = calibration_fields.reference
    fields = _Run(method, before.fibrelets).amplitudes(images, "sample").in_phase_with(reference)
    fields = fields.closed(reference, states, None).closed_over_the_facet(reference, states, before.fibrelets)
    noise = noise_scale(closure_outside(fields, reference, states)[:3], by_polarisation=True)
    return replace(
        before,
        fields=fields.values - reference,
        variance=fields.stated(noise),
        inflation=noise.inflation,
        relative_error=noise.relative_error,
        status=fields.status,
    )


def _spots_apart(record: Calibration, fibrelets: Fibrelets) -> Callable[[np.ndarray], np.ndarray | None]:
    """For captures of one pattern: the nearest of its spots to every fibrelet (m,); None where their light meets."""
    positions, inputs, count = positions_on_camera(record), record.inputs.tocsc(), len(record.points)
    pitch = lattice_pitch(fibrelets.centres)

    def owner(captures: np.ndarray) -> np.ndarray | None:
        spots = positions[np.unique(inputs[:, [captures[0]]].nonzero()[0] % count)]
        if len(spots) < 2:
            return None
        tree = scipy.spatial.cKDTree(spots)
        if tree.query(spots, k=2)[0][:, 1].min() < APART * pitch:
            return None
        return np.asarray(tree.query(fibrelets.centres)[1])

    return owner


def _closes(groups: list[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Whether most captures are one of three states or more of the same pattern."""
    sizes = [states.shape[1] for _, states in groups]
    return sum(size for size in sizes if size > 2) > 0.5 * sum(sizes)


def tracked_drift(references: np.ndarray, times: np.ndarray, fibrelets: Fibrelets, anchor: np.ndarray | None) -> Drift:
    """The drift of reference fields (n, 2, m), relative to their mean or to ``anchor`` (2, m)."""
    if len(references) < 2:
        raise ValueError(f"references must be two or more where their drift is tracked, got {len(references)}.")
    rates = None
    if len(references) == 2:
        # two alone do not tell how fast it goes: between exact ends any walk is a straight line
        apart = track_drift(references, times, fibrelets)
        span = float(np.ptp(times))
        rates = (float(np.ptp(apart.piston) ** 2) / span, float((np.ptp(apart.tilt, axis=0) ** 2).mean()) / span)
    drift = track_drift(references, times, fibrelets, rates=rates)
    if anchor is None:
        return drift
    still = drift.correct(references, times, fibrelets).mean(0)
    moved = track_drift(np.stack([anchor, still]), [0.0, 1.0], fibrelets)
    # both about their own centres: the piston is that at the centre of this record's references
    tilt = moved.tilt[1] - moved.tilt[0]
    piston = moved.piston[1] - moved.piston[0] + tilt @ (drift.centre - moved.centre)
    return replace(drift, piston=drift.piston + piston, tilt=drift.tilt + tilt)


def fibrelets_of(calibration: Calibration) -> Fibrelets:
    """The fibrelets that a calibration shows, as :func:`retrieve_fields` finds them; methods such as ``Modal`` ask for
    them first.

    They are looked for in the sum of all interference images: every capture lights others, and incoherent sums are
    even.

    Raises
    ------
    TypeError: no Calibration. ValueError: no fibrelet is seen.
    """
    one_of_types("calibration", calibration, (Calibration,), "pass a Calibration.")
    images = calibration.images
    total = np.zeros(images.frame)
    for capture in range(images.captures):
        frames = np.asarray(images.radiance[capture])[len(images.diversity) :].mean(0)
        total += frames / max(frames.max(), 1e-300)
    return locate_fibrelets(total, images.pixel_size)


@dataclass(frozen=True)
class _Run:
    """The settings of one call. closes: three states or more, whose closure measures what the drift leaves over."""

    method: RetrievalMethod
    fibrelets: Fibrelets
    progress: bool = False
    drift: Drift | None = None
    folder: str | Path | None = None
    closes: bool = True
    batch: int = 8

    def amplitudes(self, images: Images, name: str) -> CaptureAmplitudes:
        """Of all captures, with the drift taken out; those that are in the folder are not retrieved again."""
        basis = None
        if not self._in_modes():
            modes = ModeBasis(mode_matrix(self.fibrelets, images.frame, images.pixel_size))
            basis = modes, LocalPower(modes.squares, self.fibrelets.centres)
        kept = None if self.folder is None else self._kept(images, name)
        done = []
        with tqdm(total=images.captures, desc=f"fields of {name}", unit="capture", disable=not self.progress) as bar:
            for start in range(0, images.captures, self.batch):
                part = range(start, min(start + self.batch, images.captures))
                found = None if kept is None else kept.read(f"capture_{start:06d}")
                if found is None:
                    found = self._batch(images, part, basis)
                    if kept is not None:
                        kept.write(f"capture_{start:06d}", found)
                done.append(found)
                bar.update(len(part))
        whole = CaptureAmplitudes(
            *(np.concatenate([getattr(d, f) for d in done]) for f in ("values", "variance", "status", "most"))
        )
        return self._corrected(whole, images.times)

    def _corrected(self, whole: CaptureAmplitudes, times: np.ndarray) -> CaptureAmplitudes:
        if self.drift is None:
            return whole
        values = self.drift.correct(whole.values, times, self.fibrelets)
        if self.closes:
            return replace(whole, values=values)
        spread = self.drift.phase_variance(times, self.fibrelets)[:, None]
        return replace(whole, values=values, variance=whole.variance + np.abs(values) ** 2 * spread)

    def following(
        self, drift: Drift | str | None, references: Images, anchor: np.ndarray | None
    ) -> tuple[_Run, CaptureAmplitudes]:
        """The run that takes the drift out, and the references without it.

        A drift that is tracked is that of the references, and against ``anchor``, complex (2, m), if there is one.
        """
        if not isinstance(drift, str):
            run = replace(self, drift=drift)
            return run, run.amplitudes(references, "reference")
        found = self.amplitudes(references, "reference")
        tracked = tracked_drift(found.values, references.times, self.fibrelets, anchor)
        run = replace(self, drift=tracked)
        return run, run._corrected(found, references.times)

    def _kept(self, images: Images, name: str) -> Kept:
        ends = tuple(np.asarray(images.radiance[c]) for c in (0, images.captures - 1))
        shape = (images.captures, images.frame, images.wavelength, images.pixel_size)
        settings = (images.diversity, images.steps, images.times)
        call = fingerprint(shape, settings, ends, self.method, self.fibrelets, self.batch)
        return Kept(Path(self.folder or "") / name, call, (CaptureAmplitudes,), "record, method or set of fibrelets")

    def _in_modes(self) -> bool:
        """Whether the method finds the amplitudes of these very fibrelets itself."""
        if not isinstance(self.method, ModeMethod):
            return False
        theirs, ours = self.method.fibrelets, self.fibrelets
        return np.array_equal(theirs.centres, ours.centres) and np.array_equal(theirs.mode_radius, ours.mode_radius)

    def _batch(self, images: Images, part: range, given: tuple[ModeBasis, LocalPower] | None) -> CaptureAmplitudes:
        """Amplitudes of some captures, H from the defocused images and V from the phase-stepped ones; ``given`` where
        the method makes fields on the camera's pixels."""
        if given is None:
            assert isinstance(self.method, ModeMethod)
            return CaptureAmplitudes(*self.method.amplitudes(images, part))
        basis, local = given
        planes = len(images.diversity)
        # all of one capture before the next: a lazy stack makes its three parts together
        read = [(images.radiance[c], images.variance[c], images.saturated[c]) for c in part]
        radiance, noise, saturated = (np.stack([np.asarray(r[i]) for r in read]) for i in range(3))
        noise = np.where(saturated, np.inf, noise)
        diversity = Defocus(
            radiance[:, :planes], images.diversity, images.wavelength, images.pixel_size, noise[:, :planes]
        )
        retrieved = retrieve(diversity, self.method, batch=self.batch)
        fringes = relative_phase(radiance[:, planes:], images.steps, 1 / noise[:, planes:])
        values = np.empty((len(part), 2, len(self.fibrelets.centres)), complex)
        variance, most = np.empty(values.shape), np.empty(values.shape)
        for i in range(len(part)):
            h, h_variance = retrieved.field[i].astype(complex), retrieved.variance[i].astype(float)
            intensity = np.abs(h) ** 2
            power = float(intensity.sum())
            values[i, 0], variance[i, 0] = basis.amplitudes(h, h_variance, power)
            with np.errstate(divide="ignore", invalid="ignore"):
                v = fringes.product[i] / np.conj(h)
                v_variance = fringes.variance[i] / intensity
            v_variance = np.where(np.isfinite(v) & np.isfinite(v_variance), v_variance, np.inf)
            known = np.where(np.isfinite(fringes.variance[i]), 1 / fringes.variance[i], 0)
            light = 2 * fringes.mean[i] - intensity  # |V|^2
            most[i, 0], most[i, 1] = power, local(light, known, power)
            values[i, 1], variance[i, 1] = basis.amplitudes(v, v_variance, most[i, 1])
            # dividing by a weak H carries its error over, and that error is the whole mode's, not a pixel's
            ratio = np.abs(values[i, 1]) ** 2 / (np.abs(values[i, 0]) ** 2 + variance[i, 0])
            variance[i, 1] += ratio * variance[i, 0]
        return CaptureAmplitudes(values, variance, retrieved.status, most)


def pattern_groups(calibration: Calibration) -> list[tuple[np.ndarray, np.ndarray]]:
    """Captures that light the same points with the same amplitudes but for the state, and their states (2, n)."""
    inputs = calibration.inputs.tocsc()
    count = len(calibration.points)
    groups: dict[tuple, list[int]] = {}
    states = {}
    for capture in range(inputs.shape[1]):
        both = inputs[:, [capture]].toarray().reshape(2, count)
        points = np.flatnonzero(np.any(both != 0, axis=0))
        if len(points) == 0:
            continue
        # one state for all points: the field is the state times a pattern, which begins with 1
        state = both[:, points[0]]
        pattern = state.conj() @ both[:, points] / np.linalg.norm(state) ** 2
        if not np.allclose(np.outer(state, pattern), both[:, points], rtol=1e-6):
            continue  # points in different states: nothing must close
        states[capture] = state
        key = (*points.tolist(), *np.round(pattern, 6).tolist())
        groups.setdefault(key, []).append(capture)
    return [(np.array(found), np.stack([states[c] for c in found], 1)) for found in groups.values()]
