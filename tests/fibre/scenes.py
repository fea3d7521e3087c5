"""Calibration and recording fields made directly from a bundle, with complex Gaussian noise of known variance.

No images and no retrieval: what is tested with these is what comes after them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

from acquisition import CalibrationPlan
from fibre import Bundle, CalibrationFields, Fibrelets, RecordingFields
from polinfer import Parameters
from tests.oracles import jones as oracle

WAIST = 2.5e-6


def complex_noise(generator, shape):
    """E|n|^2 = 1."""
    return (generator.standard_normal(shape) + 1j * generator.standard_normal(shape)) / np.sqrt(2)


@dataclass(frozen=True)
class Scene:
    """A bundle, a plan of calibration, and the true transmission matrix A (2 m, 2 p)."""

    bundle: Bundle
    plan: CalibrationPlan
    matrix: np.ndarray
    reference: np.ndarray

    def calibration(self, noise, rng):
        """Calibration fields with noise of standard deviation ``noise`` (per complex amplitude)."""
        clean = (self.matrix @ self.plan.inputs.toarray()).T.reshape(-1, 2, self.bundle.cores)
        fields = clean + noise * complex_noise(np.random.default_rng(rng), clean.shape)
        return CalibrationFields(
            fields=fields, variance=np.full(fields.shape, noise**2), reference=self.reference, inflation=1.0,
            relative_error=0.0, fibrelets=Fibrelets(self.bundle.centres, 1.6e-6), inputs=self.plan.inputs,
            points=self.plan.points, grid=self.plan.grid, registration=np.eye(2, 3),
        )  # fmt: skip

    def recording(self, jones, light, noise, rng):
        """Recorded fields of a sample of Jones matrices (p, 2, 2), lit by ``light`` (p,) in the plan's states."""
        states = self.plan.illumination
        before = light[:, None, None] * states
        generator = np.random.default_rng(rng)

        def seen(field):
            clean = (self.matrix @ field.swapaxes(0, 1).reshape(-1, states.shape[1])).T
            return (clean + noise * complex_noise(generator, clean.shape)).reshape(-1, 2, self.bundle.cores)

        fields, blank = seen(jones @ before), seen(before)
        variance = np.full(fields.shape, noise**2)
        return RecordingFields(
            fields=fields, variance=variance, blank=blank, blank_variance=variance, inflation=1.0, relative_error=0.0,
            fibrelets=Fibrelets(self.bundle.centres, 1.6e-6), illumination=states,
        )  # fmt: skip

    def recording_between(self, jones_at, noise):
        """As :meth:`recording`, of light that is everywhere and not at the points alone; the sample's Jones matrices
        are ``jones_at`` places (q, 2). No noise is added."""
        pitch, (rows, columns) = self.plan.pitch, self.plan.grid
        y, x = (np.arange(-n - 2, n + 3) * pitch / 2 for n in (rows, columns))
        places = np.stack(np.meshgrid(y, x, indexing="ij"), -1).reshape(-1, 2)
        launch = self.bundle.launch(places, WAIST) / 4
        matrix = self.bundle.columns(scipy.sparse.block_diag([launch, launch])).toarray()
        everywhere = replace(self, plan=replace(self.plan, grid=(2 * rows + 5, 2 * columns + 5), pitch=pitch / 2),
                             matrix=matrix)  # fmt: skip
        assert np.allclose(everywhere.plan.points, places)
        found = everywhere.recording(jones_at(places), everywhere.light(), 0.0, 0)
        variance = np.full(found.fields.shape, noise**2)
        return replace(found, variance=variance, blank_variance=variance)

    def light(self, amplitude=0.5):
        """A broad beam over the points, (p,)."""
        return amplitude * np.exp(-(self.plan.points**2).sum(1) / 40e-6**2)

    def smooth_sample(self):
        """Jones matrices (p, 2, 2) that vary slowly over the points."""
        y, x = (self.plan.points / 30e-6).T
        values = Parameters(0.2 + 0.3 * y, 0.5 + 0.4 * x, 1.2 + 0.8 * x, 0.4 - 0.5 * y, 0.2 * x)
        return np.array([oracle.jones(point) for point in np.stack(values, 1)])


def scene(grid=(8, 8), stride=4, states=3, radius=25e-6, reference=(0.0, 22e-6), pitch=4.2e-6):
    """The standard scene: 109 fibrelets, 64 points."""
    bundle = Bundle.hexagonal(radius=radius, rng=0)
    plan = CalibrationPlan(grid, pitch, stride=stride, states=states)
    launch = bundle.launch(plan.points, WAIST)
    matrix = bundle.columns(scipy.sparse.block_diag([launch, launch])).toarray()
    spot = bundle.launch(np.array([reference]), WAIST).toarray()[:, 0]
    return Scene(bundle, plan, matrix, bundle.transmit(np.stack([spot, spot]) / np.sqrt(2)))


def without_noise(record):
    """The same record with a stated variance that is next to nothing."""
    return replace(record, variance=np.full(record.variance.shape, 1e-16))
