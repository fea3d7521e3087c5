"""A tilt between the arms is found with the pixels, is what the data allow, and is said to be unknown where it is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

import polinfer
from polinfer import (
    ComplexGain,
    InferredNoise,
    Measurement,
    Model,
    Parameters,
    RotatedBasis,
    Status,
    TiltPlane,
    UniformAngle,
    VonMises,
    Window,
    fit,
    simulate,
    untilt,
)
from polinfer.fitting import tilt_general
from polinfer.fitting.fast.scene import scene
from polinfer.fitting.fast.tilt import phase_responses
from polinfer.fitting.generic import prepare
from polinfer.statistics import Statistics
from tests.oracles import jones as oracle
from tests.polinfer.scenes import BALANCED, GAINS, ORDERINGS, UNBALANCED, Sandwich, X, everywhere, uniform

TILTED = Model(misalignment=TiltPlane())
RETARDER = {"diattenuation": 0.0}
SHAPE = (20, 26)


def plane(shape, piston, rows, columns):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return piston + rows * ((y + 0.5) / shape[0] - 0.5) + columns * ((x + 0.5) / shape[1] - 0.5)


def plate(shape=SHAPE, diattenuation=0.1, angle=0.5, retardance=2.6):
    return everywhere(shape, (diattenuation, 0.6, retardance, angle, 0.0))


def deviation(result, piston, rows, columns):
    """Errors of the coefficients in standard deviations."""
    error = result.tilt.coefficients[:3] - np.array([piston, rows, columns])
    error[0] -= np.pi * np.round(error[0] / np.pi)
    return error / np.sqrt(np.diag(result.tilt.covariance)[:3])


@pytest.mark.parametrize("u", [BALANCED, UNBALANCED])
def test_likelihood_is_that_of_the_matrix_products(u):
    data = simulate(Model(), everywhere((3,), X), u, 0.1, rng=1, tilt=np.array([0.3, -1.0, 2.0]))
    phase, x = np.array([0.2, 1.4, -2.5]), (0.2, 0.4, 1.0, 0.5, 0.3)
    found = np.asarray(Model().log_likelihood(Parameters(*x), data, tilt=phase))
    for k, phi in enumerate(phase):
        turn = np.diag([1, np.exp(1j * phi)])
        matrix = turn.conj() @ oracle.jones(x) @ turn
        rest = data.response[k] - matrix @ u
        expected = -np.sum(np.abs(rest) ** 2) / 0.01 - 6 * np.log(np.pi * 0.01)
        np.testing.assert_allclose(found[k], expected, rtol=1e-10)
    with pytest.raises(ValueError, match="tilt"):
        TILTED.log_likelihood(Parameters(*x), data)


@pytest.mark.parametrize(("u", "missing"), [(BALANCED, False), (BALANCED, True), (UNBALANCED, True)])
def test_taking_the_tilt_out_leaves_every_likelihood(u, missing):
    weight = np.array([1.0, 0.0, 0.5]) if missing else None
    model = Model(gain=GAINS["complex"])
    data = simulate(model, everywhere((4,), X), u, 0.1, rng=1, tilt=0.4)
    response = data.response.copy()
    if missing:
        response[:, :, 1] = np.nan
    data = Measurement(u, response, 0.1, weight)
    phase, point = np.array([0.1, 1.0, -2.0, 3.0]), Parameters(0.2, 0.4, 1.0, 0.5, 0.3)
    expected = model.log_likelihood(point, data, tilt=phase)
    np.testing.assert_allclose(model.log_likelihood(point, untilt(data, phase)), expected, rtol=1e-10)
    if not missing:  # balanced states stay shared, which is what makes the fit quick
        assert untilt(data, phase).illumination.size == u.size


@pytest.mark.parametrize(
    ("ordering", "gain", "u"),
    [
        ("retarder_first", "none", UNBALANCED),
        pytest.param("retarder_first", "complex", BALANCED, marks=pytest.mark.slow),
        pytest.param("polariser_first", "phase", BALANCED, marks=pytest.mark.slow),
        pytest.param("polariser_first", "complex", UNBALANCED, marks=pytest.mark.slow),
    ],
)
def test_derivatives_by_the_phase_are_those_of_automatic_differentiation(ordering, gain, u):
    model = Model(ORDERINGS[ordering], gain=GAINS[gain])
    rng = np.random.default_rng(3)
    truth = uniform(64, 3)._replace(diattenuation=rng.uniform(0.2, 0.6, 64), retardance=rng.uniform(0.8, 2.2, 64))
    truth = truth._replace(retardance_angle=rng.uniform(0.3, 1.2, 64), circularity=rng.uniform(-0.8, 0.8, 64))
    phase = rng.uniform(-1, 1, 64)
    data = simulate(model, truth, u, 0.01, rng=1, tilt=phase)
    own = Statistics(*prepare(model, data, False).pooled.own)
    found = phase_responses(scene(model), u is BALANCED, own, phase, None, None, 60)
    best = fit(model, untilt(data, phase)).parameters
    value, slope, bend, follow = tilt_general.respond(model, best, phase, own)
    np.testing.assert_allclose(found.value, value, rtol=1e-8)
    # the parabolas of the equivalent sets start from points that are close, not the same
    np.testing.assert_allclose(found.slope, slope, atol=2e-3)
    np.testing.assert_allclose(found.bend, bend, rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(np.abs(found.parameters), np.abs(follow), rtol=1e-3, atol=1e-3)


def test_derivatives_by_the_phase_are_those_of_fits_at_other_phases():
    model = Model()
    truth = everywhere((32,), (0.3, 0.6, 2.0, 0.6, 0.3))
    data = simulate(model, truth, BALANCED, 0.02, rng=1, tilt=0.2)
    own = Statistics(*prepare(model, data, False).pooled.own)

    def at(phase):
        return phase_responses(scene(model), True, own, np.full(32, phase), None, None, 60)

    here, step = at(0.2), 1e-4
    above, below = at(0.2 + step), at(0.2 - step)
    np.testing.assert_allclose(here.slope, (above.value - below.value) / (2 * step), atol=1e-4)
    np.testing.assert_allclose(here.bend, (above.slope - below.slope) / (2 * step), rtol=1e-3)
    ahead, behind = (fit(model, untilt(data, 0.2 + s)).parameters.retardance_angle for s in (step, -step))
    np.testing.assert_allclose(here.parameters[3], (ahead - behind) / (2 * step), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(("slopes", "sigma"), [((0, 0), 0.2), ((-3, 6), 0.05), ((-20, 40), 0.1)])
def test_the_plane_is_found(slopes, sigma):
    data = simulate(Model(), plate(), BALANCED, sigma, rng=1, tilt=plane(SHAPE, 0.3, *slopes))
    result = fit(TILTED, data)
    assert np.all(np.abs(deviation(result, 0.3, *slopes)) < 4)
    assert float(result.tilt.probability) > 0.999
    wrong = (result.status & ~int(Status.BAD_FIT | Status.UNIDENTIFIED_DIATTENUATION_ANGLE)) != 0
    assert wrong.mean() < 0.01
    known = fit(Model(), untilt(data, plane(SHAPE, 0.3, *slopes)))
    error = np.std(result.parameters.retardance - 2.6)
    assert error < 1.02 * np.std(known.parameters.retardance - 2.6)


def test_masked_and_broken_pixels_do_not_count():
    data = simulate(Model(), plate(), BALANCED, 0.05, rng=1, tilt=plane(SHAPE, -0.4, 4.0, -9.0))
    mask = np.random.default_rng(2).uniform(size=SHAPE) < 0.5
    mask[:, :9] = False
    response = data.response.copy()
    response[3, 12] = np.nan
    mask[3, 12] = True
    response[~mask] = 7.0
    result = fit(TILTED, Measurement(BALANCED, response, 0.05, mask=mask))
    assert np.all(np.abs(deviation(result, -0.4, 4.0, -9.0)) < 4)
    assert np.all(np.isfinite(result.tilt.phase))
    np.testing.assert_array_equal((result.status & int(Status.MASKED)) != 0, ~mask)
    assert result.status[3, 12] == Status.NON_FINITE
    assert np.isnan(result.tilt.response[3, 12]).all()


@pytest.mark.parametrize("gain", [pytest.param("phase", marks=pytest.mark.slow), "complex"])
def test_a_free_gain_and_the_other_ordering(gain):
    model = Model(ORDERINGS["polariser_first"], gain=GAINS[gain], misalignment=TiltPlane())
    rng = np.random.default_rng(5)
    truth = Parameters(*(x.reshape(SHAPE) for x in uniform(SHAPE[0] * SHAPE[1], 5)))._replace(
        circularity=rng.normal(0, 0.7, SHAPE)
    )
    data = simulate(model, truth, UNBALANCED, 0.05, rng=1, tilt=plane(SHAPE, 0.2, 12.0, 3.0))
    result = fit(model, data)
    assert np.all(np.abs(deviation(result, 0.2, 12.0, 3.0)) < 4)


def test_a_diattenuator_alone_tells_the_tilt():
    model = Model(misalignment=TiltPlane(), priors={"circularity": UniformAngle(2 * np.pi)})
    data = simulate(Model(), plate(diattenuation=0.5, retardance=1.0), BALANCED, 0.05, rng=1,
                    tilt=plane(SHAPE, 0.3, -5.0, 2.0))  # fmt: skip
    assert np.all(np.abs(deviation(fit(model, data), 0.3, -5.0, 2.0)) < 4)


UNKNOWN = {
    "axis at 0": (TILTED, plate(angle=0.0, retardance=np.pi)),
    "axis at 90 degrees": (TILTED, plate(angle=np.pi / 2, diattenuation=0.0)),
    "nothing there": (TILTED, plate(diattenuation=0.0, retardance=0.0)),
    "circularity may be anything": (
        Model(misalignment=TiltPlane(), fixed=RETARDER, priors={"circularity": UniformAngle(2 * np.pi)}),
        plate(diattenuation=0.0),
    ),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_a_scene_that_does_not_tell_the_tilt_is_flagged(name):
    model, truth = UNKNOWN[name]
    data = simulate(Model(), truth, BALANCED, 0.05, rng=1, tilt=plane(SHAPE, 0.3, 6.0, -2.0))
    result = fit(model, data)
    plain = fit(replace(model, misalignment=None), data)
    assert np.all(result.status & int(Status.TILT_UNIDENTIFIED))
    # no plane is taken out, none is paid for
    np.testing.assert_array_equal(result.tilt.phase, 0)
    np.testing.assert_array_equal(result.parameters.retardance, plain.parameters.retardance)
    np.testing.assert_array_equal(result.log_evidence, plain.log_evidence)
    assert np.all(result.std.circularity > np.pi / 12**0.5 - 1e-9)


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (30,), (2, 3)])
def test_frames_of_few_pixels(shape):
    data = simulate(Model(), plate(shape), BALANCED, 0.05, rng=1, tilt=0.2)
    result = fit(TILTED, data)
    assert result.tilt.phase.shape == shape
    assert np.all(np.isfinite(result.parameters.retardance))
    if len(shape) == 1 or shape[0] == 1:
        assert result.tilt.coefficients[1] == 0  # one row has no slope along rows, and its prior is left


def test_many_frames_have_a_plane_each():
    phase = np.stack([plane(SHAPE, 0.2, 3.0, -8.0), plane(SHAPE, -0.7, 0.0, 15.0)])
    data = simulate(Model(), plate((2, *SHAPE)), BALANCED, 0.05, rng=1, tilt=phase)
    both = fit(TILTED, data)
    alone = fit(TILTED, Measurement(BALANCED, data.response[1], data.sigma[1]))
    assert both.tilt.coefficients.shape == (2, 3)
    np.testing.assert_array_equal(both.tilt.coefficients[1], alone.tilt.coefficients)
    np.testing.assert_array_equal(both.parameters.retardance[1], alone.parameters.retardance)
    np.testing.assert_allclose(fit(TILTED, data, start=both).tilt.coefficients, both.tilt.coefficients, atol=1e-3)


@pytest.mark.slow  # tens of thousands of fits
def test_price_and_width_of_the_tilt_are_those_of_quadrature():
    """The evidence of the frame, integrated over planes on a grid, each with the evidence of its pixels."""
    shape = (4, 5)
    data = simulate(Model(), plate(shape, 0.0), BALANCED, 0.03, rng=1, tilt=plane(shape, 0.2, 0.5, -0.5))
    model = Model(misalignment=TiltPlane(scale=2.0), fixed=RETARDER, priors={"circularity": VonMises(0.0, 8.0)})
    result = fit(model, data)
    pistons = -0.5 * np.pi + np.pi * (np.arange(24) + 0.5) / 24
    slopes = -5.0 + 0.25 * np.arange(41)
    grid = np.stack(np.meshgrid(pistons, slopes, slopes, indexing="ij"), axis=-1).reshape(-1, 3)
    phase = model.misalignment.phase(grid, shape)
    many = Measurement(BALANCED, np.broadcast_to(data.response, (len(grid), *shape, 2, 3)), 0.03)
    pixels = fit(replace(model, misalignment=None), untilt(many, phase)).log_evidence.sum(axis=(1, 2))
    density = pixels + model.misalignment.log_prior(grid)
    total = logsumexp(density) + np.log(np.pi / 24 * 0.25**2)
    # a Gaussian stands for the sum of twenty times log cosh(8 cos x): off by the inverse of 8 times 20, and some
    assert abs(result.log_evidence.sum() - total) < 0.03
    weight = np.exp(density - logsumexp(density))
    near = np.abs(grid[:, 0] - result.tilt.coefficients[0]) < 0.5 * np.pi
    width = np.sqrt(np.sum((weight * (grid[:, 1] - np.sum(weight * grid[:, 1])) ** 2)[near]))
    np.testing.assert_allclose(np.sqrt(result.tilt.covariance[1, 1]), width, rtol=0.03)


def test_select_says_whether_a_scene_is_misaligned():
    candidates = {"aligned": Model(), "tilted": TILTED}
    for slope, verdict in ((0.0, "aligned"), (3.0, "tilted")):
        data = simulate(Model(), plate(), BALANCED, 0.05, rng=1, tilt=plane(SHAPE, 0.0, slope, 0.0))
        assert polinfer.select(candidates, data).verdict == verdict


@pytest.mark.slow  # two precisions to compile
def test_single_precision_at_a_high_signal_to_noise_ratio():
    truth, phase = plate(diattenuation=0.0), plane(SHAPE, 0.3, 5.0, -7.0)
    data = simulate(Model(), truth, BALANCED, 1e-5, rng=1, tilt=phase)
    single = Measurement(BALANCED.astype(np.complex64), data.response.astype(np.complex64), np.float64(1e-5))
    model = Model(misalignment=TiltPlane(), fixed=RETARDER)
    result, exact = fit(model, single), fit(model, data)
    assert result.parameters.retardance.dtype == np.float32
    np.testing.assert_allclose(result.tilt.coefficients, exact.tilt.coefficients, atol=1e-4)
    np.testing.assert_allclose(result.tilt.covariance, exact.tilt.covariance, rtol=1e-3, atol=1e-6)


@pytest.mark.slow  # the general route to compile
def test_an_ordering_of_ones_own():
    shape, slopes = (6, 8), (0.3, 2.0, -3.0)
    model = Model(Sandwich(), misalignment=TiltPlane(scale=3.0))
    data = simulate(Model(Sandwich()), plate(shape, 0.3), BALANCED, 0.05, rng=1, tilt=plane(shape, *slopes))
    assert np.all(np.abs(deviation(fit(model, data), *slopes)) < 4)


@pytest.mark.parametrize("scope", ["frame", pytest.param("pixel", marks=pytest.mark.slow)])
def test_an_unknown_sigma(scope):
    noise = InferredNoise(2.0, 0.005, scope)
    shape = (8, 9)
    data = simulate(Model(), plate(shape), BALANCED, 0.05, rng=1, tilt=plane(shape, 0.3, 4.0, -3.0))
    result = fit(replace(TILTED, noise=noise), replace(data, sigma=None))
    assert np.all(np.abs(deviation(result, 0.3, 4.0, -3.0)) < 4)
    assert abs(np.median(result.sigma) - 0.05) < 0.01


def test_a_window_takes_the_tilt_of_its_pixels():
    phase = plane(SHAPE, 0.3, 4.0, -3.0)
    data = simulate(Model(), plate(), BALANCED, 0.1, rng=1, tilt=phase)
    model = replace(TILTED, neighbours=Window(3, 3))
    result = fit(model, data)
    single = fit(TILTED, data)
    np.testing.assert_allclose(result.tilt.coefficients, single.tilt.coefficients, atol=0.01)
    expected = fit(Model(neighbours=Window(3, 3)), untilt(data, result.tilt.phase))
    np.testing.assert_array_equal(result.parameters.retardance, expected.parameters.retardance)


def test_a_curved_phase():
    curved = TiltPlane(order=2)
    coefficients = np.array([0.3, 5.0, -8.0, 3.0, -2.0, 4.0])
    data = simulate(Model(), plate(), BALANCED, 0.05, rng=1, tilt=curved.phase(coefficients, SHAPE))
    result = fit(Model(misalignment=curved), data)
    error = result.tilt.coefficients - coefficients
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diag(result.tilt.covariance)))


def test_rotated_basis_is_the_equation_of_the_fields_in_a_turned_basis():
    """``R(-t) V = J(0, theta_D - t) R(-t) U`` from the products, against the model without circularity."""
    t, d, td, eta = 0.5, 0.3, 0.8, 1.2
    back = oracle.rotation(-t)
    expected = np.linalg.inv(back) @ oracle.jones((d, td - t, eta, 0.0, 0.77)) @ back
    model = Model(neighbours=Window(3, 5), misalignment=RotatedBasis())
    np.testing.assert_allclose(model.jones(Parameters(d, td, eta, t, np.nan)), expected, atol=1e-12)
    assert replace(model, gain=ComplexGain(1.0)).fixed == {"circularity": 0.0}


def test_arguments_that_make_no_sense_are_refused():
    for arguments in ({"scale": 0.0}, {"order": 0}, {"order": 9}):
        with pytest.raises(ValueError, match=next(iter(arguments))):
            TiltPlane(**arguments)
    with pytest.raises(ValueError, match="neighbours"):
        Model(misalignment=RotatedBasis())
    with pytest.raises(ValueError, match="circularity"):
        Model(misalignment=RotatedBasis(), neighbours=Window(3, 5), priors={"circularity": UniformAngle(2 * np.pi)})
    with pytest.raises(TypeError, match="misalignment"):
        Model(misalignment=0.3)
    with pytest.raises(ValueError, match="tilt"):
        untilt(Measurement(np.eye(2), np.ones((3, 2, 2)), 0.1), np.zeros((4, 3)))
    with pytest.raises(ValueError, match="tilt"):
        untilt(Measurement(np.eye(2), np.ones((3, 2, 2)), 0.1), np.nan)
