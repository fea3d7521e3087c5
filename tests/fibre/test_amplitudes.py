"""Captures of one scene closed over the facet: the scene's light is turned, the reference spot's is not."""

import numpy as np
import pytest

from fibre import Fibrelets
from fibre.amplitudes import CaptureAmplitudes, closure_outside
from fibre.closure import noise_scale

STATES = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)
NOISE = 0.05


@pytest.fixture
def scene():
    """Fibrelets, a reference spot with faint light around it, clean light in three states, captures bent by waves."""
    rng = np.random.default_rng(4)
    centres = np.stack(np.mgrid[:40, :40], -1).reshape(-1, 2) * 4.5e-6
    away = np.hypot(*(centres - [90e-6, 170e-6]).T)
    reference = np.outer([1, 1j], 100 * np.exp(-((away / 6e-6) ** 2)))
    dark = np.exp(-((away / 30e-6) ** 2)) < 0.05  # the scene keeps clear of the spot
    response = (rng.standard_normal((2, 2, 1600)) + 1j * rng.standard_normal((2, 2, 1600))) * dark
    clean = np.einsum("pam,an->npm", response, STATES)
    bend = np.array([0.2, 0.8, -1.0])[:, None] * 0.5 * np.cos(centres[:, 0] / 60e-6)
    noise = NOISE / 2**0.5 * (rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape))
    variance = np.full(clean.shape, NOISE**2)
    captures = CaptureAmplitudes(
        reference + clean * np.exp(1j * bend)[:, None] + noise, variance, np.zeros(3), variance
    )
    return Fibrelets(centres, np.array(1.6e-6)), reference, clean, captures


def test_the_scene_is_turned_and_the_spot_is_not(scene):
    fibrelets, reference, clean, captures = scene
    found = captures.closed_over_the_facet(reference, STATES, fibrelets).values - reference
    spot = np.abs(reference).sum(0) > 1e-3
    lit = ~spot & (np.abs(clean).sum((0, 1)) > 0)
    # of the spot nothing is left but noise, though its faintest fibrelets are as bright as the scene
    assert (np.abs(found[..., spot]) ** 2).mean() < 1.2 * NOISE**2
    before, after = (noise_scale(closure_outside(c, reference, STATES)[:3]).relative_error for c in
                     (captures, captures.closed_over_the_facet(reference, STATES, fibrelets)))  # fmt: skip
    assert after < 0.3 * before
    assert lit.sum() > 1000
