"""Momentum finds what averaging finds, sooner; the brightness of the planes can be found along."""

import numpy as np
import pytest

from fibre import Accelerated, Defocus, GerchbergSaxton, RetrievalStatus, retrieve
from fibre.retrieval import accelerated
from fibre.retrieval.base import misfit
from tests.fibre.test_retrieval import BUNDLE, FRAME, PIXEL, PLANES, errors, stack


@pytest.fixture(scope="module")
def bright():
    return stack(1e4, count=2)


@pytest.mark.parametrize("photons", [300, 1e4])
def test_the_field_is_found_within_twice_the_photon_limit(photons):
    data = stack(photons, count=2, seed=1)
    found = retrieve(data.defocus(), Accelerated())
    assert np.all(found.status == RetrievalStatus.OK)
    assert np.all(errors(found.field, data.truth) < 2 * data.photon_limit)
    assert np.all(errors(found.field, data.truth) > 0.5 * data.photon_limit)


def test_momentum_lowers_the_misfit_further_than_as_many_averaging_steps(bright):
    data = bright.defocus()
    plain = retrieve(data, GerchbergSaxton(iterations=5, averaging=25, tolerance=0.0, restarts=0, coarsening=1))
    short = retrieve(data, Accelerated(sweeps=5, iterations=3, tolerance=0.0))
    compiled = accelerated._run._cache_size()
    fast = retrieve(data, Accelerated(sweeps=5, iterations=25, tolerance=0.0))
    assert accelerated._run._cache_size() == compiled > 0  # of any number of steps
    assert np.all(fast.iterations - short.iterations == 22)
    amplitudes = np.sqrt(bright.images).astype(np.float32)
    weights = np.minimum(1, bright.images / 4).astype(np.float32)
    masks = data.masks.astype(np.complex64)
    left = [misfit(found.field, amplitudes, weights, masks) for found in (plain, fast)]
    assert np.all(left[1] < left[0])


def test_uneven_planes_are_found():
    bright = stack(1e7, count=2)
    gains = np.array([1.0, 0.7, 1.3, 1 / 0.7, 1 / 1.3])[:, None, None]
    data = bright.defocus(intensities=bright.images * gains, variance=bright.variance * gains**2)
    blind, seeing = (retrieve(data, Accelerated(gain_spread=s)) for s in (0.0, 0.5))
    assert np.all(errors(seeing.field, bright.truth) < 0.5 * errors(blind.field, bright.truth))


def test_saturated_pixels_may_hold_anything(bright):
    lost = bright.images > 0.4 * bright.images.max()
    images, variance = np.where(lost, 1e7, bright.images), np.where(lost, np.inf, bright.variance)
    found = retrieve(bright.defocus(intensities=images, variance=variance), Accelerated())
    assert np.all(errors(found.field, bright.truth) < 3 * bright.photon_limit)


def test_a_dark_image_gives_a_dark_field():
    dark = Defocus(np.zeros((5, *FRAME)), PLANES, BUNDLE.wavelength, PIXEL, np.ones((5, *FRAME)))
    found = retrieve(dark, Accelerated(gain_spread=0.1))
    assert np.abs(found.field).max() < 1e-6


def test_settings_out_of_range_are_named():
    with pytest.raises(ValueError, match="iterations must be >= 1"):
        Accelerated(iterations=0)
    with pytest.raises(ValueError, match="gain_spread"):
        Accelerated(gain_spread=-1.0)
