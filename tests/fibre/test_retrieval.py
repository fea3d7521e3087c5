"""Phase retrieval finds the field behind noisy images, near the photon limit, and says when it does not."""

from dataclasses import dataclass

import numpy as np
import pytest

from fibre import Bundle, Defocus, Diversity, GerchbergSaxton, RetrievalStatus, retrieve
from fibre.retrieval import gerchberg_saxton

BUNDLE = Bundle.hexagonal(radius=15e-6, rng=0)
PIXEL, FRAME = 0.72e-6, (72, 72)
PLANES = np.array([-50, -25, 0, 25, 50]) * 1e-6


@dataclass(frozen=True)
class Stack:
    """Fields (b, y, x) of random phase in every fibrelet, and their noisy images, in photo-electrons."""

    truth: np.ndarray
    images: np.ndarray
    variance: np.ndarray

    def defocus(self, **changes):
        arguments = {"intensities": self.images, "distances": PLANES, "variance": self.variance} | changes
        return Defocus(wavelength=BUNDLE.wavelength, pixel_size=PIXEL, **arguments)

    @property
    def photon_limit(self):
        """Relative error of a field whose every pixel has amplitude and phase from the photons of m images.

        The square root of a Poisson number has variance 1/4, its phase quadrature as much; m images are averaged.
        """
        return np.sqrt(self.truth[0].size / (2 * len(PLANES))) / np.linalg.norm(self.truth, axis=(1, 2))


def stack(photons, count=4, seed=0):
    """``photons``: in the brightest pixel in focus. Light beyond what the camera sees is lost, as in a real one."""
    generator = np.random.default_rng(seed)
    c = generator.uniform(0.3, 1.3, (count, 2, BUNDLE.cores)) * np.exp(2j * np.pi * generator.random(BUNDLE.cores))
    c = c * np.exp(2j * np.pi * generator.random(c.shape))
    seen = BUNDLE.image(c, FRAME, PIXEL, [0.0, *PLANES])[:, :, 0].astype(complex)
    seen *= np.sqrt(photons / np.abs(seen[:, :1]).max((1, 2, 3), keepdims=True) ** 2)
    images = np.abs(seen[:, 1:]) ** 2
    noisy = generator.poisson(images).astype(float)
    return Stack(seen[:, 0], noisy, np.maximum(noisy, 1.0))


def errors(found, truth):
    """Relative error of every field, modulo its piston."""
    overlap = np.einsum("byx,byx->b", found.conj(), truth)
    turned = found * np.exp(1j * np.angle(overlap))[:, None, None]
    return np.linalg.norm(turned - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))


@pytest.fixture(scope="module")
def bright():
    return stack(1e4)


@pytest.fixture(scope="module")
def solved(bright):
    return retrieve(bright.defocus(), GerchbergSaxton())


@pytest.mark.parametrize("photons", [300, 1e3, 1e4])
def test_the_field_is_found_within_twice_the_photon_limit(photons):
    data = stack(photons, seed=1)
    found = retrieve(data.defocus(), GerchbergSaxton())
    error = errors(found.field, data.truth)
    assert np.all(error < 2 * data.photon_limit)
    assert np.all(error > 0.5 * data.photon_limit)  # no better than photons allow
    assert np.all(found.status == RetrievalStatus.OK)


def test_the_stated_variance_is_the_mean_squared_error_within_a_factor_of_two(bright, solved):
    stated = np.sqrt(solved.variance.sum((1, 2))) / np.linalg.norm(bright.truth, axis=(1, 2))
    ratio = errors(solved.field, bright.truth) ** 2 / stated**2
    assert np.all((ratio > 0.5) & (ratio < 2))


def test_more_planes_are_less_error():
    data = stack(1e3, seed=2)
    few = data.defocus(
        intensities=data.images[:, 1:4], variance=data.variance[:, 1:4], distances=PLANES[1:4]
    )  # fmt: skip
    fewer, all_ = (retrieve(d, GerchbergSaxton()) for d in (few, data.defocus()))
    assert np.all(errors(all_.field, data.truth) < errors(fewer.field, data.truth))


@pytest.mark.parametrize("factor", [1.3, 0.7])
def test_wrong_distances_are_a_misfit(bright, factor):
    found = retrieve(bright.defocus(distances=factor * PLANES), GerchbergSaxton())
    assert np.all(found.status & RetrievalStatus.MISFIT)


def test_distances_wrong_by_a_tenth_are_noticed(bright):
    found = retrieve(bright.defocus(distances=1.1 * PLANES), GerchbergSaxton())
    assert np.all(found.status != RetrievalStatus.OK)


def test_reversed_distances_give_the_conjugate_field_and_no_misfit(bright):
    """|P_z E| = |P_-z E*|: the one error of distances that the images cannot show."""
    found = retrieve(bright.defocus(distances=-PLANES), GerchbergSaxton())
    assert np.all(errors(found.field.conj(), bright.truth) < 2 * bright.photon_limit)
    assert np.all(found.status == RetrievalStatus.OK)


def test_one_iteration_has_not_converged(bright):
    found = retrieve(bright.defocus(), GerchbergSaxton(iterations=1, averaging=0, restarts=0))
    assert np.all(found.status & RetrievalStatus.NOT_CONVERGED)
    assert np.all(found.iterations == 1)


def test_saturated_pixels_may_hold_anything(bright, solved):
    lost = bright.images > 0.4 * bright.images.max()
    images, variance = np.where(lost, 1e7, bright.images), np.where(lost, np.inf, bright.variance)
    assert lost.sum() > 100
    found = retrieve(bright.defocus(intensities=images, variance=variance), GerchbergSaxton())
    assert np.all(errors(found.field, bright.truth) < 1.5 * errors(solved.field, bright.truth))
    assert np.all(errors(found.field, solved.field) < bright.photon_limit)
    believed = retrieve(bright.defocus(intensities=images), GerchbergSaxton())
    assert np.all(errors(believed.field, bright.truth) > 0.5)  # they would have done harm


def test_averaging_brings_the_error_down(bright, solved):
    raw = retrieve(bright.defocus(), GerchbergSaxton(averaging=0))
    assert errors(solved.field, bright.truth).mean() < 0.9 * errors(raw.field, bright.truth).mean()


@pytest.mark.parametrize(("batch", "piece"), [(1, 1), (3, 64)])
def test_a_field_is_the_same_in_any_company(bright, solved, monkeypatch, batch, piece):
    """One by one, as on processors, or many in one array, as on accelerators, filled up to a power of two."""
    monkeypatch.setattr(gerchberg_saxton, "piece", lambda processor, accelerator: min(piece, accelerator))
    found = retrieve(bright.defocus(), GerchbergSaxton(), batch=batch)
    np.testing.assert_allclose(found.field, solved.field, atol=1e-4 * np.abs(solved.field).max())
    np.testing.assert_array_equal(found.iterations, solved.iterations)


def test_a_moving_field_begins_again_only_where_noise_does_not_explain_its_images(solved):
    """Stopped after eight sweeps, the last of which moved most fields by more than the tolerance; the code is that of
    ``solved``, of 150."""
    compiled = gerchberg_saxton._solve._cache_size()
    data, early = stack(1e4, seed=3), GerchbergSaxton(iterations=8)
    found = retrieve(data.defocus(), early)
    assert np.count_nonzero(found.iterations == 8 + early.averaging) >= 2
    assert np.all(found.iterations <= 8 + early.averaging)
    assert np.all(errors(found.field, data.truth) < 2 * data.photon_limit)
    wrong = retrieve(data.defocus(distances=1.3 * PLANES), early)
    assert np.all(wrong.iterations == 3 * (8 + early.averaging))
    assert gerchberg_saxton._solve._cache_size() == compiled > 0


def test_leading_axes_are_fields(bright, solved):
    reshaped = bright.defocus(
        intensities=bright.images.reshape(2, 2, 5, *FRAME), variance=bright.variance.reshape(2, 2, 5, *FRAME)
    )
    found = retrieve(reshaped, GerchbergSaxton())
    assert found.field.shape == found.variance.shape == (2, 2, *FRAME)
    assert found.status.shape == found.iterations.shape == (2, 2)
    np.testing.assert_array_equal(found.field.reshape(4, *FRAME), solved.field)


def test_the_unit_of_the_images_does_not_matter(bright, solved):
    scaled = retrieve(
        bright.defocus(intensities=1e6 * bright.images, variance=1e12 * bright.variance), GerchbergSaxton()
    )
    assert np.all(errors(scaled.field / 1e3, solved.field) < 0.02 * bright.photon_limit)
    np.testing.assert_allclose(scaled.variance, 1e6 * solved.variance, rtol=1e-3)


def test_without_variances_the_misfit_is_the_noise(bright):
    found = retrieve(bright.defocus(variance=None), GerchbergSaxton())
    assert np.all(errors(found.field, bright.truth) < 3 * bright.photon_limit)
    stated = np.sqrt(found.variance.sum((1, 2))) / np.linalg.norm(bright.truth, axis=(1, 2))
    assert np.all((stated > 0.3 * bright.photon_limit) & (stated < 3 * bright.photon_limit))


def test_any_masks_will_do(bright):
    """Random phase masks instead of lenses: the method knows masks, not distances."""
    generator = np.random.default_rng(5)
    masks = np.exp(0.5j * np.pi * generator.normal(size=(5, *FRAME)))
    masks *= np.abs(np.asarray(Defocus(bright.images[0], PLANES, BUNDLE.wavelength, PIXEL).masks)) > 0
    passed = np.fft.ifft2(np.fft.fft2(bright.truth)[:, None] * masks)
    images = np.abs(passed) ** 2
    found = retrieve(Diversity(images, masks, BUNDLE.wavelength, PIXEL), GerchbergSaxton(iterations=400))
    assert np.median(errors(found.field, bright.truth)) < 0.02


def test_a_dark_image_gives_a_dark_field_and_no_nan():
    dark = Defocus(np.zeros((5, *FRAME)), PLANES, BUNDLE.wavelength, PIXEL, np.ones((5, *FRAME)))
    found = retrieve(dark, GerchbergSaxton())
    assert np.all(np.isfinite(found.field))
    assert np.abs(found.field).max() < 1e-6
