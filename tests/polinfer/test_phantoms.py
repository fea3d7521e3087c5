"""Every phantom obeys its physics, witnessed by plain matrices, closed forms and statistics of many pixels."""

import numpy as np
import pytest
from scipy.linalg import expm

import polinfer
from polinfer import Parameters, phantoms, simulate
from polinfer.records import RANGES
from tests.oracles.jones import jones as oracle_jones

X, Y, Z = np.array([[0, 1], [1, 0]]), np.array([[0, -1j], [1j, 0]]), np.diag([1, -1])
SHAPE = (5, 7)
EVERY = {
    "plate": lambda rng: phantoms.half_wave_plate(SHAPE, [0.0, 1.0, 2.0], rng, variation=0.2, wedge=0.1),
    "stretched gel": lambda rng: phantoms.stretched_gel(SHAPE, [1.0, 1.5, 2.5], rng, variation=0.2, axis_variation=1.0),
    "scattering gel": lambda rng: phantoms.scattering_gel(SHAPE, rng, frames=3, retardance=3.0, diattenuation=1.0),
    "solution": lambda rng: phantoms.chiral(SHAPE, [-2.0, 0.0, 0.3], rng, retardance=0.4, variation=0.2),
    "film": lambda rng: phantoms.film(SHAPE, [0.0, 1.0, 2.0], rng, diattenuation=0.9, variation=0.5),
    "lesion": lambda rng: phantoms.lesion(SHAPE, rng, diameter=3, fold=2, edge=0.2, variation=2.0),
    "cohort": lambda rng: phantoms.cohort(SHAPE, rng),
}


def matrices(scene):
    """g J of every pixel by the oracle's matrix products."""
    p = [np.asarray(x).ravel() for x in scene.parameters]
    products = np.array([oracle_jones(values) for values in zip(*p, strict=True)])
    return scene.gain.ravel()[:, None, None] * products


@pytest.mark.parametrize("name", EVERY)
def test_all_values_are_in_their_ranges_and_a_seed_makes_the_same_scene_again(name):
    scene, again, other = (EVERY[name](rng) for rng in (4, 4, 5))
    for value, (low, high) in zip(scene.parameters, RANGES, strict=True):
        assert ((value >= low) & (value <= high)).all()
    assert scene.seed == 4
    np.testing.assert_array_equal(scene.gain, again.gain)
    for first, second in zip(scene.parameters, again.parameters, strict=True):
        np.testing.assert_array_equal(first, second)
    assert any(not np.array_equal(a, b) for a, b in zip(scene.parameters, other.parameters, strict=True))
    assert scene.labels.max() < len(scene.names)
    fresh = EVERY[name](None)
    np.testing.assert_array_equal(EVERY[name](fresh.seed).gain, fresh.gain)


@pytest.mark.parametrize("name", [n for n in EVERY if n != "lesion"])
def test_a_series_is_its_frames(name):
    scene = EVERY[name](1)
    frames = [scene[i] for i in range(len(scene))]
    np.testing.assert_array_equal(np.stack([f.parameters.retardance for f in frames]), scene.parameters.retardance)
    np.testing.assert_array_equal(scene[-1].gain, scene.gain[-1])
    assert frames[0].labels.shape == SHAPE
    with pytest.raises(IndexError, match="frames"):
        scene[len(scene)]
    with pytest.raises(TypeError, match="one frame"):
        len(frames[0])


def test_a_half_wave_plate_mirrors_the_plane_of_vibration_at_its_axis():
    plate = phantoms.half_wave_plate((1, 1), np.radians([0, 20, 70, 110]))
    for t, jones in zip(np.radians([0, 20, 70, 110]), matrices(plate), strict=True):
        for incoming in (0.0, 0.4):
            out = jones @ [np.cos(incoming), -np.sin(incoming)]
            mirrored = np.array([np.cos(2 * t - incoming), -np.sin(2 * t - incoming)])
            assert abs(abs(mirrored @ out) - 1) < 1e-12


def test_a_retardance_beyond_pi_is_the_same_matrix_after_it_was_wrapped():
    plate = phantoms.half_wave_plate((1, 1), [0.3], retardance=4.0)
    axis = Z * np.cos(0.6) - X * np.sin(0.6)
    np.testing.assert_allclose(matrices(plate)[0], expm(0.5j * 4.0 * axis), atol=1e-12)


def test_a_wedge_turns_with_the_plate():
    plate = phantoms.half_wave_plate((5, 5), [0.0, np.pi / 2], wedge=0.1)
    phase = np.angle(plate.gain)
    np.testing.assert_allclose(np.diff(phase[0], axis=1), 0.1, atol=1e-12)
    np.testing.assert_allclose(np.diff(phase[0], axis=0), 0.0, atol=1e-12)
    # the axis at 90 degrees points up the rows
    np.testing.assert_allclose(np.diff(phase[1], axis=0), -0.1, atol=1e-12)


@pytest.mark.parametrize("thinning", [0.0, 0.5, 1.0])
def test_a_stretched_gel_keeps_its_volume_and_follows_the_stress_of_its_network(thinning):
    stretch = np.linspace(0.8, 2.0, 200001)
    thin, width = phantoms.gel_thickness(stretch, 1.0, thinning), stretch ** (thinning - 1)
    np.testing.assert_allclose(stretch * width * thin, 1.0, rtol=1e-12)
    # the tension that does the work of the network's energy G/2 (a^2 + b^2 + c^2 - 3), the width held or free: the
    # stress along the stretch less that across it is a dW/da - b dW/db at fixed thickness direction
    step = 1e-6

    def energy(a, b):
        return 0.5 * (a**2 + b**2 + 1 / (a * b) ** 2)

    along = stretch * (energy(stretch + step, width) - energy(stretch - step, width)) / (2 * step)
    across = width * (energy(stretch, width + step) - energy(stretch, width - step)) / (2 * step)
    np.testing.assert_allclose(phantoms.gel_birefringence(stretch, 1.0, thinning), along - across, atol=1e-8)
    gel = phantoms.stretched_gel((1, 1), [1.0, 1.3], coefficient=3e-5, thinning=thinning, wavelength=600e-9)
    assert gel.parameters.retardance[0, 0, 0] == 0
    expected = 2 * np.pi * 3e-5 * (1.3**2 - 1.3 ** (2 * thinning - 2)) * 2e-3 * 1.3**-thinning / 600e-9
    np.testing.assert_allclose(gel.parameters.retardance[1], expected, rtol=1e-12)


def test_retardance_over_thickness_recovers_the_birefringence_from_noisy_data():
    stretches = np.linspace(1.0, 1.4, 6)
    # the recovery knows neither of the uneven strain nor of the axis that wanders
    gel = phantoms.stretched_gel((24, 24), stretches, rng=1, variation=0.05, axis_variation=0.05)
    data = simulate(polinfer.Model(), gel.parameters, np.eye(2), 0.02, rng=2, gain=gel.gain)
    found = polinfer.decompose(data.response, polinfer.RetarderFirst()).retardance
    turned = np.angle(np.exp(1j * found).mean(axis=(1, 2))) * 850e-9 / (2 * np.pi)
    np.testing.assert_allclose(
        turned[1:] / phantoms.gel_thickness(stretches[1:]), phantoms.gel_birefringence(stretches[1:]), rtol=0.05
    )


@pytest.mark.parametrize(("alpha", "linear"), [(0.3, 0.0), (-1.2, 0.0), (0.4, 0.9), (2.5, 1.0), (0.0, 0.5), (0.0, 0.0)])
def test_a_chiral_solution_is_the_exponential_of_what_happens_along_its_path(alpha, linear):
    scene = phantoms.chiral((1, 1), alpha, retardance=linear, retardance_angle=0.3)
    generator = linear * (np.cos(0.6) * Z - np.sin(0.6) * X) + 2 * alpha * Y
    np.testing.assert_allclose(matrices(scene)[0], expm(0.5j * generator), atol=1e-12)
    if linear == 0:
        turned = matrices(scene)[0] @ [np.cos(0.2), -np.sin(0.2)]
        np.testing.assert_allclose(turned, [np.cos(0.2 + alpha), -np.sin(0.2 + alpha)], atol=1e-12)


def test_a_film_transmits_its_share_along_and_across_its_axis():
    jones = matrices(phantoms.film((1, 1), [0.4], diattenuation=0.6, transmission=0.5))[0]
    along, across = np.array([np.cos(0.4), -np.sin(0.4)]), np.array([np.sin(0.4), np.cos(0.4)])
    assert np.sum(abs(jones @ along) ** 2) == pytest.approx(0.5 * 1.6)
    assert np.sum(abs(jones @ across) ** 2) == pytest.approx(0.5 * 0.4)
    perfect = phantoms.film(SHAPE, rng=1, diattenuation=1.0, variation=0.5)
    assert (perfect.parameters.diattenuation == 1).all()


def test_scattered_light_has_its_mean_its_contrast_and_its_memory():
    gel = phantoms.scattering_gel((256, 256), rng=1, grain=1.0, frames=3, memory=0.8)
    straight, scattered = np.exp(-1.1), 0.5 * np.exp(-0.1) * (1 - np.exp(-1))
    intensity = np.abs(gel.gain) ** 2
    patches = 256**2 / (4 * np.pi)  # independent ones in a frame
    spread = np.sqrt(scattered**2 + 2 * scattered * straight)  # of the intensity of a Rician amplitude
    assert abs(intensity[0].mean() - straight - scattered) < 4 * spread / np.sqrt(patches)
    assert intensity[0].std() == pytest.approx(spread, rel=0.05)
    moving = gel.gain - np.sqrt(straight)
    for k in (1, 2):
        together = (np.conj(moving[0]) * moving[k]).mean() / scattered
        assert abs(together - 0.8**k) < 4 / np.sqrt(patches)
    axes = gel.parameters.diattenuation_angle[0]
    axes = np.sign(gel.parameters.diattenuation[0]) * np.exp(2j * axes)
    assert abs(axes.mean()) < 4 / np.sqrt(patches)  # no axis is preferred


def test_the_axis_of_random_retarders_is_uniform_on_the_sphere():
    p = phantoms.scattering_gel((256, 256), rng=2, grain=1.0, retardance=1.0).parameters
    sign = np.sign(p.retardance)
    stokes = sign * np.stack([
        np.cos(2 * p.retardance_angle), np.sin(2 * p.retardance_angle) * np.cos(p.circularity),
        np.sin(2 * p.retardance_angle) * np.sin(p.circularity),
    ])  # fmt: skip
    patches = 256**2 / (4 * np.pi)
    np.testing.assert_allclose(stokes.mean(axis=(1, 2)), 0, atol=4 / np.sqrt(3 * patches))
    second = np.einsum("iyx,jyx->ij", stokes, stokes) / 256**2
    np.testing.assert_allclose(second, np.eye(3) / 3, atol=4 * 0.3 / np.sqrt(patches))


def test_correlated_fields_have_the_stated_variance_and_correlation():
    from polinfer.phantoms.random_fields import smooth_field

    for scale in (0.3, 1.0, 3.0):
        field = smooth_field(np.random.default_rng(0), (512, 512), scale)
        patches = 512**2 / max(8 * np.pi * scale**2, 1)  # of the square of the field
        assert abs((field**2).mean() - 1) < 5 * np.sqrt(2 / patches)
        for shift in (1, 2, 5):
            expected = np.exp(-(shift**2) / (4 * scale**2)) if scale >= 1 else 0.0
            measured = (field[shift:] * field[:-shift]).mean()
            assert abs(measured - expected) < 5 * np.sqrt(2 / patches) + (0.02 if scale < 1 else 0.0)


def test_a_lesion_scene_has_its_four_regions_and_what_they_are_made_of():
    scene = phantoms.lesion((96, 96), rng=5, diameter=30, fold=6, edge=0.15, phase_disorder=3.0, smoothness=3.0)
    area = np.bincount(scene.labels.ravel(), minlength=4) / 96**2
    assert area[1] == pytest.approx(np.pi * 15**2 / 96**2, rel=0.25)
    assert area[3] == pytest.approx(0.15, rel=0.2)
    p = scene.parameters
    far = np.abs(p.retardance) < 1e-2
    assert (scene.labels[far] == 3).mean() > 0.95
    deep = scene.labels == 3
    assert np.abs(scene.gain[deep]).mean() == pytest.approx(1, abs=0.02)

    def roughness(label):
        step = np.angle(scene.gain[:, 1:] * np.conj(scene.gain[:, :-1]))
        return np.std(step[(scene.labels[:, 1:] == label) & (scene.labels[:, :-1] == label)])

    assert roughness(1) > 1.7 * roughness(0)
    assert roughness(2) > 1.7 * roughness(0)
    assert roughness(3) < 0.5 * roughness(0)
    none = phantoms.lesion((96, 96), rng=5, diameter=0)
    assert (none.labels == 0).all()


def test_a_cohort_has_diseased_samples_and_controls_that_differ_by_what_is_stated():
    many = phantoms.cohort((8, 8), rng=1, diseased=0, control=400, variation=0.0)
    inside = many.labels == 0
    means = np.array([many.parameters.retardance_angle[i][inside[i]].mean() for i in range(400) if inside[i].any()])
    assert means.mean() == pytest.approx(0.6, abs=4 * 0.15 / 20)
    assert means.std() == pytest.approx(0.15, rel=0.2)
    same = phantoms.cohort((48, 48), rng=2, between=0.0, variation=0.0)
    for i in range(9):
        ill = same[i].labels == 1
        assert ill.any() == (i < 6)
        if ill.any():
            assert same[i].parameters.diattenuation_angle[ill].max() == pytest.approx(0.95, abs=0.01)


def test_a_tilt_is_kept_beside_the_parameters_and_not_in_them():
    ramp = 0.1 * np.arange(7)
    tilted, plain = (phantoms.half_wave_plate(SHAPE, [0.2, 0.5], tilt=t) for t in (ramp, None))
    np.testing.assert_array_equal(tilted.tilt, np.broadcast_to(ramp, (2, *SHAPE)))
    assert plain.tilt is None
    np.testing.assert_array_equal(matrices(tilted), matrices(plain))


@pytest.mark.parametrize(
    ("error", "message", "make"),
    [
        (ValueError, "rows, columns", lambda: phantoms.film((3,))),
        (ValueError, "shape must be >= 1", lambda: phantoms.film((0, 3))),
        (ValueError, "tilt must broadcast", lambda: phantoms.film((2, 3), tilt=np.zeros((3, 2, 3)))),
        (ValueError, "stretches must be > 0", lambda: phantoms.stretched_gel((2, 3), [0.0])),
        (ValueError, "variation 50 makes a stretch", lambda: phantoms.stretched_gel((9, 9), 2.0, rng=0, variation=50)),
        (ValueError, "at least one sample", lambda: phantoms.cohort(diseased=0, control=0)),
        (
            ValueError,
            "one for each of names",
            lambda: phantoms.Phantom(Parameters(0, 0, 0, 0, 0), labels=3, names=("a",)),
        ),
        (TypeError, "labels must be integers", lambda: phantoms.Phantom(Parameters(0, 0, 0, 0, 0), labels=1.0)),
        (ValueError, "does not broadcast", lambda: phantoms.Phantom(Parameters(*np.zeros((5, 3))), gain=np.ones(2))),
    ],
)
def test_what_cannot_be_is_refused_with_its_name(error, message, make):
    with pytest.raises(error, match=message):
        make()
