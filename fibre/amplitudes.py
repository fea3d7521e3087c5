"""Mode amplitudes of captures, and how those of one scene are put into phase with each other.

In: amplitudes as retrieval leaves them, each capture with a phase of its own. Out: the same in phase with the reference
spot and closed over the illumination states, and the closure errors that are left. Called by ``retrieve_fields``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fibre.closure import NoiseScale, closure_errors, closure_phase_maps, closure_phases, closure_tilts
from fibre.fibrelets import reference_region
from fibre.records import Fibrelets
from polinfer.storage import array

__all__ = ["CaptureAmplitudes", "closure_outside", "mean_reference_of"]


@dataclass(frozen=True)
class CaptureAmplitudes:
    """Mode amplitudes of some captures, complex (captures, 2, m), the variance that the image noise explains, the
    retrieval's status (captures,), and the most that a variance can be."""

    values: np.ndarray = array(("capture", "polarisation", "fibrelet"), "sqrt(photo-electrons/s)")
    variance: np.ndarray = array(("capture", "polarisation", "fibrelet"), "photo-electrons/s")
    status: np.ndarray = array(("capture",), "1")
    most: np.ndarray = array(("capture", "polarisation", "fibrelet"), "photo-electrons/s")

    def of(self, captures: np.ndarray) -> CaptureAmplitudes:
        """Some of the captures."""
        return CaptureAmplitudes(
            self.values[captures], self.variance[captures], self.status[captures], self.most[captures]
        )

    def stated(self, noise: NoiseScale) -> np.ndarray:
        """The variance with all that the images' noise does not explain."""
        return noise.variance(self.values, self.variance, self.most)

    def in_phase_with(self, reference: np.ndarray) -> CaptureAmplitudes:
        """Turn every capture so that the reference spot has the phase it has alone."""
        overlap = np.einsum("pk,cpk->c", np.conj(reference) * _reference_region(reference), self.values)
        return self.turned(-np.angle(overlap))

    def turned(self, phases: np.ndarray) -> CaptureAmplitudes:
        """Every capture turned by its phase, radians."""
        return replace(self, values=self.values * np.exp(1j * phases)[:, None, None])

    def closed(self, reference: np.ndarray, states: np.ndarray, fibrelets: Fibrelets | None) -> CaptureAmplitudes:
        """Captures of one scene in several states, turned so that they close best; with ``fibrelets`` tilted too."""
        outside = ~_reference_region(reference)
        fields, variance = (self.values - reference)[..., outside], self.variance[..., outside]
        if fibrelets is None:
            return self.turned(closure_phases(fields, variance, states))
        middle = fibrelets.centres[outside].mean(0)
        pistons, tilts = closure_tilts(fields, variance, states, fibrelets.centres[outside])
        phase = pistons[:, None] + tilts @ (fibrelets.centres - middle).T
        return replace(self, values=self.values * np.exp(1j * phase)[:, None])

    def closed_over_the_facet(
        self, reference: np.ndarray, states: np.ndarray, fibrelets: Fibrelets
    ) -> CaptureAmplitudes:
        """Captures of one scene turned by phases that change slowly over the facet, so that they close best."""
        outside = ~_reference_region(reference)
        fields, variance = (self.values - reference)[..., outside], self.variance[..., outside]
        turn = np.exp(1j * closure_phase_maps(fields, variance, states, fibrelets.centres[outside]))
        values = self.values.copy()
        # the reference spot's own light, also that beside its brightest fibrelets, has the phase it has alone
        values[..., outside] = reference[:, outside] + fields * turn[:, None]
        return replace(self, values=values)

    def closed_apart(self, reference: np.ndarray, states: np.ndarray, owner: np.ndarray) -> CaptureAmplitudes:
        """Captures of spots whose light does not meet, that of each turned by itself; ``owner`` (m,): its spot."""
        outside = ~_reference_region(reference)
        fields, values = self.values - reference, self.values.copy()
        for spot in np.unique(owner):
            near = outside & (owner == spot)
            phases = closure_phases(fields[..., near], self.variance[..., near], states)
            values[..., near] = reference[:, near] + fields[..., near] * np.exp(1j * phases)[:, None, None]
        return replace(self, values=values)


def mean_reference_of(reference: CaptureAmplitudes) -> np.ndarray:
    """The reference spot alone, complex (2, m), 0 where its light is not clearly above the noise.

    It is subtracted from every capture; subtracting noise would put the same error into all states, where their
    closure cannot see it. The image noise is some ten times less than what retrieval really leaves in the dark.
    """
    mean = reference.in_phase_with(reference.values[0]).values.mean(0)
    noise = 10 * reference.variance.mean(0) / len(reference.values)
    return mean * np.maximum(1 - noise / np.maximum(np.abs(mean) ** 2, 1e-300), 0)


def _reference_region(reference: np.ndarray) -> np.ndarray:
    """Fibrelets that carry the reference spot of this field (2, m)."""
    return reference_region((np.abs(reference) ** 2).sum(0))


def closure_outside(fields: CaptureAmplitudes, reference: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Closure errors (4, 2, count) of both polarisations outside the reference spot, whose light does not follow the
    states."""
    outside = ~_reference_region(reference)
    values, variance = fields.values[..., outside], fields.variance[..., outside]
    squared, stated, _ = closure_errors(values - reference[:, outside], variance, states)
    _, _, seen = closure_errors(values, variance, states)
    mean = (np.abs(fields.values) ** 2).mean((1, 2), keepdims=True)
    _, _, light = closure_errors(np.sqrt(mean), mean, states)
    rows = np.stack([squared, stated, seen, np.broadcast_to(light, seen.shape)])  # (4, closures, 2, fibrelets)
    return rows.swapaxes(1, 2).reshape(4, 2, -1)
