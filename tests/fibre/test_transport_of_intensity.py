"""The transport of intensity finds smooth phases, in light and shade, and the lenses of a measured array."""

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest
import scipy.fft
import scipy.ndimage

from fibre import Defocus, Diversity, TransportOfIntensity, angular_spectrum, retrieve
from fibre.retrieval import transport_of_intensity
from polinfer import datasets

WAVELENGTH, PIXEL, N = 550e-9, 1e-6, 128
PLANES = np.array([-6, -3, 0, 3, 6]) * 1e-6
Y, X = 2 * np.pi * np.mgrid[:N, :N] / N
PERIODIC = 1.5 * np.cos(X) + 0.8 * np.sin(3 * X + 2 * Y)
# even about the edges of the frame, so that nothing flows through them
EVEN = sum(
    a * np.cos(i * np.pi * (np.arange(N)[:, None] + 0.5) / N) * np.cos(j * np.pi * (np.arange(N) + 0.5) / N)
    for a, i, j in ((1.5, 0, 1), (-1.0, 1, 2), (0.4, 5, 3))
)
DISC = scipy.ndimage.gaussian_filter((np.hypot(X - 3.1, Y - 3.1) < 2.3).astype(float), 2)
HOLE = 1 - np.exp(-((X - 2) ** 2 + (Y - 4) ** 2) / 0.3**2)  # an amplitude of exactly 0 within
UNEVEN = 1 + 0.6 * np.cos(2 * X - Y) * np.cos(Y)


def images(field, planes=PLANES):
    return np.stack([np.abs(angular_spectrum(field, z, WAVELENGTH, PIXEL)) ** 2 for z in planes])


def mirrored_images(field, planes=PLANES):
    """What a frame between mirrors would see: the frame is the quarter of an even one."""
    whole = np.pad(field, [(0, N), (0, N)], mode="symmetric")
    return images(whole, planes)[:, :N, :N]


def defocus(stack, planes=PLANES, variance=None):
    return Defocus(stack, planes, WAVELENGTH, PIXEL, variance)


def phase_error(found, truth):
    """Standard deviation over the light, radians, common phase apart."""
    turned = found * np.exp(-1j * np.angle(truth) - 1j * np.angle(np.vdot(truth, found)))
    weight = np.abs(truth) ** 2
    return np.sqrt((weight * np.angle(turned) ** 2).sum() / weight.sum())


@pytest.mark.parametrize(
    ("amplitude", "tolerance"), [(np.ones((N, N)), 0.005), (UNEVEN, 0.01), (DISC, 0.02), (HOLE, 0.01)]
)
@pytest.mark.parametrize("variances", [False, True])
def test_the_phase_of_a_propagated_field_is_found(amplitude, tolerance, variances):
    truth = amplitude * np.exp(1j * PERIODIC)
    stack = images(truth)
    found = retrieve(defocus(stack, variance=np.ones_like(stack) if variances else None), TransportOfIntensity())
    assert found.field.dtype == np.complex64
    assert found.status == 0
    assert np.all(np.isfinite(found.field))
    assert phase_error(found.field, truth) < tolerance
    np.testing.assert_allclose(np.abs(found.field), amplitude, atol=0.01)


def test_light_of_a_converging_lens_gathers_further_along_the_beam():
    """phi = -k r^2 / 2f: the sign on paper, I rises by 2 I / f per metre within the lens."""
    f, k = 2e-3, 2 * np.pi / WAVELENGTH
    y, x = (np.mgrid[:N, :N] - N / 2) * PIXEL
    inside = np.hypot(x, y) < 25e-6
    soft = scipy.ndimage.gaussian_filter((np.hypot(x, y) < 50e-6).astype(float), 4)
    z = np.array([0, 1e-6])
    # the transport equation itself, by numpy.gradient: no propagation
    phase = -k * (x**2 + y**2) / (2 * f)
    flux = [np.gradient(soft * g, PIXEL, axis=i) for i, g in enumerate(np.gradient(phase, PIXEL))]
    slope = -(flux[0] + flux[1]) / k
    assert np.median(slope[inside]) == pytest.approx(2 / f, rel=0.01)
    found = retrieve(defocus(np.stack([soft, soft + z[1] * slope]), z), TransportOfIntensity())
    got = np.angle(found.field * found.field[N // 2, N // 2].conj())[inside]
    fit = np.polyfit((x**2 + y**2)[inside], got, 1)
    assert -k / (2 * fit[0]) == pytest.approx(f, rel=0.01)


def test_reversed_distances_give_the_conjugate():
    truth = UNEVEN * np.exp(1j * PERIODIC)
    forth = retrieve(defocus(images(truth)), TransportOfIntensity()).field
    back = retrieve(defocus(images(truth), -PLANES), TransportOfIntensity()).field
    assert phase_error(back, forth.conj()) < 1e-3


@pytest.mark.parametrize(
    ("planes", "tolerance"),
    [([0, 2], 0.01), ([-3, 1], 0.01), ([2, 4, 7], 0.01), ([-9, -6, -3, 0, 3, 6, 9], 0.01), ([3, 3, -3], 0.02)],
)
@pytest.mark.parametrize("variances", [False, True])
def test_planes_need_not_be_symmetric_nor_hold_the_focus(planes, tolerance, variances):
    planes = np.array(planes) * 1e-6
    truth = UNEVEN * np.exp(1j * PERIODIC)
    stack = images(truth, planes)
    method = TransportOfIntensity(order=3)
    found = retrieve(defocus(stack, planes, np.ones_like(stack) if variances else None), method)
    assert phase_error(found.field, truth) < tolerance


def test_cosines_know_a_frame_between_mirrors_and_waves_do_not():
    truth = np.exp(1j * EVEN)
    mirrored, periodic = (
        retrieve(defocus(mirrored_images(truth)), TransportOfIntensity(mirrored=m)).field for m in (True, False)
    )
    assert phase_error(mirrored, truth) < 0.01
    assert phase_error(periodic, truth) > 0.1


def test_cosines_are_waves_of_the_frame_and_its_mirror_images():
    truth = UNEVEN * np.exp(1j * EVEN)
    stack = mirrored_images(truth, PLANES[1:4])
    method = {"iterations": 30, "tolerance": 1e-6, "regularisation": 0.03}
    one = retrieve(defocus(stack, PLANES[1:4]), TransportOfIntensity(mirrored=True, **method)).field
    whole = np.pad(stack, [(0, 0), (0, N), (0, N)], mode="symmetric")
    # twice the frame: twice the cycles for the same length
    method["regularisation"] *= 2
    other = retrieve(defocus(whole, PLANES[1:4]), TransportOfIntensity(**method)).field[:N, :N]
    assert phase_error(one, other) < 1e-3


def test_dark_light_and_mirrored_frames_agree_where_the_edge_is_dark():
    truth = DISC * np.exp(1j * PERIODIC)
    one, other = (retrieve(defocus(images(truth)), TransportOfIntensity(mirrored=m)).field for m in (True, False))
    assert phase_error(one, other) < 0.02


@pytest.mark.parametrize("name", ["regularisation", "darkest"])
@pytest.mark.parametrize("amplitude", [UNEVEN, DISC, HOLE])
def test_the_phase_keeps_its_size_over_a_decade_of_regularisation(name, amplitude):
    truth = amplitude * np.exp(1j * PERIODIC)
    stack = images(truth)
    middle = getattr(TransportOfIntensity(), name)
    weight = amplitude**2
    for value in middle * np.array([10**-0.5, 1, 10**0.5]):
        found = retrieve(defocus(stack), TransportOfIntensity(**{name: value})).field
        got = PERIODIC + np.angle(found * np.exp(-1j * PERIODIC) / np.exp(1j * np.angle(np.vdot(truth, found))))
        mean = (weight * PERIODIC).sum() / weight.sum()
        size = (weight * got * (PERIODIC - mean)).sum() / (weight * PERIODIC * (PERIODIC - mean)).sum()
        assert size == pytest.approx(1, abs=0.03)


def test_one_step_is_the_inverse_laplacian_and_right_for_uniform_light():
    truth = np.exp(1j * PERIODIC)
    method = TransportOfIntensity(iterations=0, regularisation=1e-3)
    found = retrieve(defocus(images(truth)), method)
    assert phase_error(found.field, truth) < 0.005
    assert (found.iterations, found.status) == (0, 0)
    # sources that share no code: second derivatives of cosines by scipy's transform, mirrored
    rough = np.random.default_rng(0).normal(size=(N, N))
    smooth = scipy.ndimage.gaussian_filter(rough, 4, mode="reflect")
    q = np.pi * np.arange(N) / N
    laplacian = scipy.fft.idctn(-(q[:, None] ** 2 + q**2) * scipy.fft.dctn(smooth)) / PIXEL**2
    z, k = 1e-7, 2 * np.pi / WAVELENGTH
    stack = np.stack([np.ones((N, N)), 1 - z * laplacian / k])
    found = retrieve(defocus(stack, [0, z]), TransportOfIntensity(iterations=0, regularisation=1e-3, mirrored=True))
    assert np.std(np.angle(found.field) - smooth) < 0.01 * smooth.std()


def test_refinement_counts_its_steps_and_says_when_it_is_not_done():
    stack = images(UNEVEN * np.exp(1j * PERIODIC))
    assert retrieve(defocus(stack), TransportOfIntensity(iterations=2)).status & 1
    compiled = transport_of_intensity._solve._cache_size()
    full = retrieve(defocus(stack), TransportOfIntensity())
    assert transport_of_intensity._solve._cache_size() == compiled > 0  # steps are counted by the same code
    assert full.status == 0
    assert 3 < full.iterations < 40


def test_the_batch_does_not_matter():
    fields = [a * np.exp(1j * PERIODIC) for a in (UNEVEN, DISC, np.ones((N, N)))]
    stack = np.stack([images(f) for f in fields])
    together = retrieve(defocus(stack), TransportOfIntensity())
    for one, field, count in zip(stack, together.field, together.iterations, strict=True):
        alone = retrieve(defocus(one), TransportOfIntensity())
        np.testing.assert_allclose(field, alone.field, atol=1e-3)
        assert count == alone.iterations


def test_saturated_pixels_may_hold_anything():
    truth = UNEVEN * np.exp(1j * PERIODIC)
    stack = images(truth)
    lost = np.random.default_rng(3).random(stack.shape) < 0.15
    lost[0] = lost[4] = False
    variance = np.where(lost, np.inf, 1.0)
    found = retrieve(defocus(np.where(lost, 1e6, stack), variance=variance), TransportOfIntensity())
    assert phase_error(found.field, truth) < 0.01
    assert np.all(np.isfinite(found.variance))


def test_pixels_without_a_usable_plane_are_bridged_and_said_to_be_unknown():
    truth = np.exp(1j * PERIODIC)
    stack = images(truth)
    variance = np.full(stack.shape, 1e-4)
    variance[:, 60:64, 30:34] = np.inf
    found = retrieve(defocus(stack, variance=variance), TransportOfIntensity())
    kept = np.ones((N, N))
    kept[57:67, 27:37] = 0
    assert phase_error(found.field, kept * truth) < 0.15
    assert np.all(np.isfinite(found.field))
    assert found.variance[62, 32] == pytest.approx(1, rel=0.1)
    assert found.variance[10, 10] < 0.1


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_stated_variance_is_the_mean_squared_error(mirrored):
    generator = np.random.default_rng(4)
    photons = 3e4
    truth = np.sqrt(photons) * np.ones((N, N)) + 0j
    errors, stated = [], []
    for _ in range(16):
        noisy = generator.poisson(np.full((5, N, N), photons)).astype(float)
        found = retrieve(defocus(noisy, variance=noisy), TransportOfIntensity(mirrored=mirrored))
        turned = found.field * np.exp(-1j * np.angle(np.vdot(truth, found.field)))
        errors.append((np.abs(turned - truth) ** 2).mean())
        stated.append(found.variance.mean())
    # some ten waves of low frequency hold most of the error: 16 draws of it are good to a tenth or two
    assert np.mean(errors) == pytest.approx(np.mean(stated), rel=0.4)


def test_weights_are_inverse_variances():
    """numpy.linalg.lstsq in every pixel, on planes of unlike noise; then an exact phase of the same source."""
    generator = np.random.default_rng(5)
    stack = 1 + 0.01 * generator.normal(size=(5, 8, 8))
    variance = generator.uniform(0.1, 3, stack.shape)
    from fibre.retrieval.transport_of_intensity import _fit

    powers = (PLANES / 6e-6)[:, None] ** np.arange(3)
    got = _fit(*(a[None].astype(np.float32) for a in (stack, 1 / variance)), powers.astype(np.float32))
    for y in range(8):
        for x in range(8):
            root = 1 / np.sqrt(variance[:, y, x])
            rows = root[:, None] * powers
            want = np.linalg.lstsq(rows, root * stack[:, y, x], rcond=None)[0]
            spread = np.diag(np.linalg.inv(rows.T @ rows))
            np.testing.assert_allclose([a[0, y, x] for a in got], [*want[:2], *spread[:2]], rtol=1e-3, atol=1e-5)


def test_a_lamp_that_drifts_is_no_lens():
    truth = DISC * np.exp(1j * PERIODIC)
    drift = 1 + 0.05 * PLANES / PLANES.max()
    found = retrieve(defocus(images(truth) * drift[:, None, None]), TransportOfIntensity())
    assert phase_error(found.field, truth) < 0.02


def test_a_dark_image_gives_a_dark_field_and_no_nan():
    for variance in (None, np.ones((5, N, N)), np.full((5, N, N), np.inf)):
        found = retrieve(Defocus(np.zeros((5, N, N)), PLANES, WAVELENGTH, PIXEL, variance), TransportOfIntensity())
        assert np.all(found.field == 0)
        assert np.all(np.isfinite(found.variance))


def test_odd_frames_and_oblong_ones_are_frames():
    truth = np.exp(1j * PERIODIC)[:, : N - 1]
    stack = images(truth)
    found = retrieve(defocus(stack), TransportOfIntensity(mirrored=True))
    assert found.field.shape == (N, N - 1)
    assert np.all(np.isfinite(found.field))


def test_errors_say_what_to_do():
    stack = np.ones((3, 8, 8))
    masks = np.ones((3, 8, 8), complex)
    with pytest.raises(ValueError, match="distances must be given, got None; build the stack with Defocus"):
        retrieve(Diversity(stack, masks, WAVELENGTH, PIXEL), TransportOfIntensity())
    with pytest.raises(ValueError, match="distances must differ"):
        retrieve(Defocus(stack, [1e-6] * 3, WAVELENGTH, PIXEL), TransportOfIntensity())
    for wrong in ({"order": 0}, {"iterations": -1}, {"tolerance": 0.0}, {"regularisation": 0.0}, {"darkest": 2.0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be"):
            TransportOfIntensity(**wrong)
    with pytest.raises(TypeError, match="mirrored must be bool"):
        TransportOfIntensity(mirrored=1)


@pytest.fixture(scope="module")
def example():
    """The example of the measured lenses, as a module; skipped where the data are not."""
    try:
        folder = datasets.data_directory()
        if not (folder / "tie_microlens" / "Iz.tiff").is_file():
            raise FileNotFoundError(f"directory has no tie_microlens; expected it at {folder}.")
    except FileNotFoundError as error:
        if os.environ.get("POLINFER_REQUIRE_DATA") == "1":
            pytest.fail(f"POLINFER_REQUIRE_DATA=1, but {error}")
        pytest.skip(f"measured data are not here: {error}")
    path = Path(__file__).resolve().parents[2] / "examples" / "08_microlens.py"
    specification = importlib.util.spec_from_file_location("microlens", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_measured_lenses_of_one_array_agree_and_stay_over_a_decade_of_regularisation(example):
    stack = example.read()
    lengths = {}
    for value, darkest in ((0.01, 0.001), (0.03, 0.003), (0.1, 0.01)):
        field, lenses = example.focal_lengths(stack, TransportOfIntensity(regularisation=value, darkest=darkest))
        assert np.all(np.isfinite(field))
        lengths[value] = np.array([length for length, *_ in lenses])
    usual = lengths[0.03]
    assert np.all(usual > 0)  # the published distance and the package's sign: they converge
    assert len(usual) >= 5
    assert np.abs(usual / usual.mean() - 1).max() < 0.03
    for other in lengths.values():
        np.testing.assert_allclose(other, usual, rtol=0.03)
