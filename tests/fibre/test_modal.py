"""Modal retrieval finds mode amplitudes at the photon limit without a guess, and what the bench did not say."""

import numpy as np
import pytest
import scipy.spatial

from fibre import Bundle, Defocus, Diversity, Fibrelets, Modal, RetrievalStatus, angular_spectrum, retrieve
from fibre.propagation import transfer_function
from fibre.retrieval.modal.newton import Found, Problem, _State, make_coupling, refine
from fibre.retrieval.modal.start import make_neighbours, spreads, synchronise
from fibre.retrieval.modal.views import coarse_images, coarse_variance, make_views

BUNDLE = Bundle.hexagonal(radius=26e-6, rng=0)
FIBRELETS = Fibrelets(BUNDLE.centres, BUNDLE.mode_radius)
PIXEL, FRAME = 0.39e-6, (192, 192)
NEAR = np.linspace(-25e-6, 25e-6, 7)


class Scene:
    """Random amplitudes, what they look like through a finer grid, and noisy images in photo-electrons."""

    def __init__(self, distances, photons=1e4, focus=0.0, gains=1.0, seed=1, lit=None):
        rng = np.random.default_rng(seed)
        c = rng.standard_normal((2, BUNDLE.cores)) + 1j * rng.standard_normal((2, BUNDLE.cores))
        c = c if lit is None else c * lit
        fine = BUNDLE.image(c, FRAME, PIXEL, np.asarray(distances) + focus, oversampling=2)[:, 0]
        images = (np.abs(fine) ** 2).reshape(len(distances), FRAME[0], 2, FRAME[1], 2).mean((2, 4))
        self.images = images * np.broadcast_to(gains, len(distances))[:, None, None]
        scale = photons / self.images.max()
        self.counts = rng.poisson(self.images * scale) + 2 * rng.standard_normal(self.images.shape)
        self.variance = np.maximum(self.images * scale, 0) + 4
        self.field = BUNDLE.image(c, FRAME, PIXEL)[0] * np.sqrt(scale)
        self.amplitudes = c[0] * np.sqrt(scale) / PIXEL
        self.distances = np.asarray(distances)

    def diversity(self, **changes):
        given = {"intensities": self.counts, "distances": self.distances, "variance": self.variance} | changes
        return Defocus(wavelength=BUNDLE.wavelength, pixel_size=PIXEL, **given)

    @property
    def limit(self):
        """Relative error from the photons: amplitude and phase of each mode from all its photo-electrons."""
        return np.sqrt(BUNDLE.cores / (2 * self.counts.sum()))


def error(found, truth):
    """Relative, modulo piston."""
    turn = np.exp(1j * np.angle(np.vdot(found, truth)))
    return float(np.linalg.norm(found * turn - truth) / np.linalg.norm(truth))


@pytest.fixture(scope="module")
def near():
    return Scene(NEAR)


@pytest.mark.parametrize("photons", [300, 1e4])
def test_the_field_is_found_within_a_few_photon_limits(photons):
    scene = Scene(NEAR, photons)
    found = retrieve(scene.diversity(), Modal(FIBRELETS))
    assert found.status == RetrievalStatus.OK
    assert scene.limit < error(found.field, scene.field) < 4 * scene.limit + 0.002  # modes end at three radii


def test_neighbours_products_alone_give_the_field_within_a_fifth(near):
    masks = transfer_function(FRAME, NEAR, BUNDLE.wavelength, PIXEL).astype(np.complex64)
    views = make_views(FIBRELETS, masks, PIXEL, None)
    fields, radii = spreads(FIBRELETS, masks, PIXEL)
    equations = make_neighbours(FIBRELETS, views, fields, radii, PIXEL)
    powers, products = equations.products(coarse_images(near.counts.astype(np.float32), views.step))
    i, j = equations.pairs.T
    true = near.amplitudes[i] * near.amplitudes[j].conj()
    touching = np.hypot(*(BUNDLE.centres[i] - BUNDLE.centres[j]).T) < 6e-6
    assert np.linalg.norm((products - true)[touching]) < 0.2 * np.linalg.norm(true[touching])
    assert error(synchronise(equations.pairs, powers, products), near.amplitudes) < 0.2


def test_phases_are_put_together_exactly_from_exact_products():
    rng = np.random.default_rng(3)
    points = rng.uniform(size=(60, 2))
    pairs = scipy.spatial.cKDTree(points).query_pairs(0.35, output_type="ndarray")
    c = rng.standard_normal(60) + 1j * rng.standard_normal(60)
    found = synchronise(pairs, np.abs(c) ** 2, c[pairs[:, 0]] * c[pairs[:, 1]].conj())
    assert error(found, c) < 1e-6


def test_a_mode_spreads_as_the_gaussian_beam_does():
    masks = transfer_function(FRAME, NEAR, BUNDLE.wavelength, PIXEL)
    _, radii = spreads(Fibrelets(np.zeros((1, 2)), 3e-6), masks, PIXEL)
    length = np.pi * 3e-6**2 / BUNDLE.wavelength
    np.testing.assert_allclose(radii, 3e-6 * np.sqrt(1 + (NEAR / length) ** 2), rtol=0.03)  # paraxial


def test_views_are_the_bundles_and_their_adjoint_is_one(near):
    masks = transfer_function(FRAME, NEAR, BUNDLE.wavelength, PIXEL).astype(np.complex64)
    for coarsening in (1, None, 2.4):
        views = make_views(FIBRELETS, masks, PIXEL, coarsening)
        fields = views.fields(views.spectrum(near.amplitudes))
        expected = angular_spectrum(near.field.astype(complex), NEAR[1], BUNDLE.wavelength, PIXEL)
        intensity = coarse_images((np.abs(expected) ** 2).astype(np.float32)[None], views.step)[0]
        assert np.abs(np.abs(fields[1]) ** 2 - intensity).max() < 0.02 * intensity.max()
        rng = np.random.default_rng(0)
        x = rng.standard_normal(BUNDLE.cores) + 1j * rng.standard_normal(BUNDLE.cores)
        y = (rng.standard_normal(fields.shape) + 1j * rng.standard_normal(fields.shape)).astype(np.complex64)
        total = np.zeros(fields.shape[1:], np.complex64)
        for i, field in enumerate(y.copy()):
            views.collect(total, field, i)
        ahead, back = np.vdot(y, views.fields(views.spectrum(x))), np.vdot(views.amplitudes(total), x)
        assert abs(ahead - back) < 1e-5 * np.linalg.norm(y) * np.linalg.norm(x)


@pytest.mark.parametrize("step", [2, 2.4, 3])
def test_variances_on_the_coarse_grid_are_those_of_its_images(step):
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:48, :96]
    variance = (5 + np.sin(2 * np.pi * y / 48) * np.cos(2 * np.pi * x / 96)).astype(np.float32)
    images = np.sqrt(variance) * rng.standard_normal((4000, 48, 96)).astype(np.float32)
    found = coarse_variance(variance[None], step)[0]
    # five camera pixels' worth of equal parts in each: any coarse pixel is a whole number of parts
    parts = np.repeat(np.repeat(variance.astype(float), 5, 0), 5, 1)
    few, width = (round(48 / step), round(96 / step)), round(5 * step)
    mean = parts.reshape(few[0], width, few[1], width).mean((1, 3))
    np.testing.assert_allclose(found, mean / step**2, rtol=1e-6)
    seen = coarse_images(images, step).var(0)
    # the highest frequency of an even number of pixels is half lost
    assert abs(np.mean(seen / found) - 1) < 1 / few[0]
    # 4000 draws know each to 2.2 %, and the band limit's tails reach farther than a coarse pixel
    assert np.std(seen / found) < 0.03
    variance[10, 20] = np.inf
    assert np.flatnonzero(np.isinf(coarse_variance(variance[None], step))).tolist() == [
        int(10 / step) * few[1] + int(20 / step)
    ]


def test_pixels_of_the_grid_need_not_be_whole_ones_of_the_camera(near):
    found = retrieve(near.diversity(), Modal(FIBRELETS, coarsening=2.4))
    assert found.status == RetrievalStatus.OK
    assert error(found.field, near.field) < 4 * near.limit + 0.005  # 0.58 mode radii: spectra are cut earlier


def test_derivatives_are_those_of_the_images(near):
    masks = transfer_function(FRAME, NEAR, BUNDLE.wavelength, PIXEL).astype(np.complex64)
    views = make_views(FIBRELETS, masks, PIXEL, None)
    fy, fx = (np.fft.fftfreq(n, views.pixel_size) for n in views.masks.shape[-2:])
    axial = np.sqrt(np.maximum(BUNDLE.wavelength**-2 - fy[:, None] ** 2 - fx**2, 0)) - 1 / BUNDLE.wavelength
    images = np.zeros((7, *views.masks.shape[-2:]), np.float32)  # rounding must not hide the derivative
    problem = Problem(images, np.ones_like(images), (2 * np.pi * axial).astype(np.float32), 1e-6, 0.1)
    c, rng = near.amplitudes / np.abs(near.amplitudes).max(), np.random.default_rng(0)
    step = rng.standard_normal(len(c)) + 1j * rng.standard_normal(len(c))

    def residual(amplitudes, focus, gains):
        return _State(views, problem, Found(amplitudes, focus, gains)).residual.astype(float)

    gains, h = np.linspace(0.9, 1.1, 7), 1e-2
    state = _State(views, problem, Found(c, 2e-6, gains))
    by_hand = (residual(c + h * step, 2e-6, gains) - residual(c - h * step, 2e-6, gains)) / (2 * h)
    assert np.linalg.norm(state.forward(step) - by_hand) < 2e-3 * np.linalg.norm(by_hand)
    back = state.adjoint(state.forward(step))
    assert np.vdot(step, back).real == pytest.approx(float((by_hand**2).sum()), rel=5e-3)
    np.testing.assert_allclose(state.curvature(step, np.arange(7)), back, rtol=1e-3, atol=1e-4 * np.abs(back).max())
    one = state.curvature(step, np.array([2]))
    assert np.vdot(step, one).real == pytest.approx(7 * float((by_hand[2] ** 2).sum()), rel=1e-2)
    slope = np.vdot(state.gradient(), step).real
    assert slope == pytest.approx(float((residual(c, 2e-6, gains) * by_hand).sum()), rel=5e-3)
    focus, *each = state.nuisance()
    by_hand = (residual(c, 2.05e-6, gains) - residual(c, 1.95e-6, gains)) / 0.1
    assert np.linalg.norm(focus - by_hand) < 2e-2 * np.linalg.norm(by_hand)
    moved = gains + 0.1 * np.eye(7)[2]
    by_hand = residual(c, 2e-6, moved) - residual(c, 2e-6, gains)
    assert np.linalg.norm(each[2] - by_hand) < 2e-3 * np.linalg.norm(by_hand)


def test_a_focus_offset_and_uneven_planes_are_found():
    gains = np.array([1.0, 0.97, 1.03, 1.0, 0.98, 1.02, 1.0])
    scene = Scene(NEAR, 1e5, focus=1.5e-6, gains=gains)
    blind, seeing = Modal(FIBRELETS), Modal(FIBRELETS, focus_spread=3e-6, gain_spread=0.05, steps=20)
    errors = [error(retrieve(scene.diversity(), method).field, scene.field) for method in (blind, seeing)]
    assert errors[1] < 0.01
    assert errors[0] > 3 * errors[1]


def test_planes_far_from_focus_are_started_by_sweeps():
    scene = Scene(np.array([-60, -40, -25, 25, 40, 60]) * 1e-6, 1e4)
    found = retrieve(scene.diversity(), Modal(FIBRELETS))
    assert error(found.field, scene.field) < 0.05


def test_two_designed_masks_do_instead_of_lenses(near):
    # astigmatism and its opposite: neither is a defocus
    fy, fx = (np.fft.fftfreq(n, PIXEL) for n in FRAME)
    bend = 14e-6 * np.pi * BUNDLE.wavelength * (fy[:, None] ** 2 - fx**2)
    masks = np.exp(1j * np.stack([bend, -bend, np.zeros(FRAME)]))
    images = np.abs(np.fft.ifft2(np.fft.fft2(near.field) * masks)) ** 2
    counts = np.random.default_rng(0).poisson(images).astype(float)
    found = retrieve(Diversity(counts, masks, BUNDLE.wavelength, PIXEL, images + 1), Modal(FIBRELETS))
    assert error(found.field, near.field) < 0.05


def test_saturated_pixels_may_hold_anything(near):
    counts, variance = near.counts.copy(), near.variance.copy()
    high = counts > 0.6 * counts.max()
    counts[high], variance[high] = counts.max(), np.inf
    found = retrieve(near.diversity(intensities=counts, variance=variance), Modal(FIBRELETS))
    assert error(found.field, near.field) < 0.02


def test_dark_fibrelets_are_dark():
    lit = np.hypot(*BUNDLE.centres.T) < 12e-6
    scene = Scene(NEAR, lit=lit)
    found = retrieve(scene.diversity(), Modal(FIBRELETS))
    assert error(found.field, scene.field) < 0.02
    assert np.all(np.isfinite(found.field))


def test_lit_fibrelets_that_the_start_leaves_dark_are_found(near):
    masks = transfer_function(FRAME, NEAR, BUNDLE.wavelength, PIXEL).astype(np.complex64)
    views = make_views(FIBRELETS, masks, PIXEL, None)
    _, radii = spreads(FIBRELETS, masks, PIXEL)
    coupling = make_coupling(scipy.spatial.cKDTree(FIBRELETS.centres), views, radii)
    problem = Problem(*(coarse_images(x.astype(np.float32), views.step) for x in (near.counts, 1 / near.variance)))
    start = near.amplitudes.copy()
    dark = np.argsort(np.abs(start))[-8:]
    start[dark] = 0
    found = refine(views, coupling, problem, Found(start, 0.0, np.ones(7)), 12, 8, 2e-3).amplitudes
    turn = np.exp(1j * np.angle(np.vdot(found, near.amplitudes)))
    assert np.linalg.norm((found * turn - near.amplitudes)[dark]) < 0.05 * np.linalg.norm(near.amplitudes[dark])


def test_a_black_image_gives_a_black_field():
    images = np.zeros((7, *FRAME))
    found = retrieve(Defocus(images, NEAR, BUNDLE.wavelength, PIXEL, images + 1), Modal(FIBRELETS))
    np.testing.assert_array_equal(found.field, 0)


def test_reversed_distances_give_the_conjugate_field(near):
    found = retrieve(near.diversity(distances=-NEAR), Modal(FIBRELETS))
    assert error(found.field, near.field.conj()) < 0.02


@pytest.mark.parametrize(
    ("make", "kind", "words"),
    [
        (lambda: Modal(np.zeros((3, 2))), TypeError, "fibrelets must be Fibrelets"),
        (lambda: Modal(FIBRELETS, steps=0), ValueError, "steps"),
        (lambda: Modal(FIBRELETS, focus_spread=-1.0), ValueError, "focus_spread"),
    ],
)
def test_wrong_settings_are_named(make, kind, words):
    with pytest.raises(kind, match=words):
        make()


def test_unsuitable_images_are_refused(near):
    masks = np.ones((7, *FRAME), complex)
    other = Diversity(near.counts, masks, BUNDLE.wavelength, PIXEL)
    with pytest.raises(ValueError, match="focus_spread is positive"):
        retrieve(other, Modal(FIBRELETS, focus_spread=1e-6))
    for coarsening in (5, 2.3):
        with pytest.raises(ValueError, match=f"coarsening is {coarsening}"):
            retrieve(near.diversity(), Modal(FIBRELETS, coarsening=coarsening))
