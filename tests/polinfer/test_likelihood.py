"""The log likelihood by sufficient statistics is the direct sum, and the gain is really integrated out."""

import numpy as np
import pytest
from scipy import integrate

from polinfer import ComplexGain, KnownNoise, Measurement, Model, Parameters, PhaseGain, PolariserFirst, RetarderFirst
from polinfer.statistics import least_squares_jones, summarise
from tests.oracles import jones as oracle
from tests.polinfer.scenes import X


def data(states, seed=0, sigma=0.2):
    generator = np.random.default_rng(seed)
    u, v = (generator.normal(size=(2, 2, states)) + 1j * generator.normal(size=(2, 2, states))) / 2
    return u, oracle.jones(X) @ u + sigma * v


@pytest.mark.parametrize("states", [1, 2, 3, 7])
@pytest.mark.parametrize("ordering", ["retarder_first", "polariser_first"])
def test_any_number_of_states_gives_the_direct_sum(states, ordering):
    u, v = data(states)
    model = Model(RetarderFirst() if ordering == "retarder_first" else PolariserFirst())
    got = model.log_likelihood(Parameters(*X), Measurement(u, v, 0.2))
    assert float(got) == pytest.approx(oracle.log_likelihood(X, u, v, 0.2, ordering), abs=1e-10)


def test_weights_and_missing_states_give_the_direct_sum():
    u, v = data(5)
    weight = np.array([1.0, 0.0, 2.5, 0.3, 1.0])
    v[:, 1] = np.nan  # a missing state may hold anything
    got = Model().log_likelihood(Parameters(*X), Measurement(u, v, 0.2, weight))
    assert float(got) == pytest.approx(oracle.log_likelihood(X, u, v, 0.2, weight=weight), abs=1e-10)


def test_parallel_and_dark_states_give_the_direct_sum():
    u, v = data(3)
    u[:, 1:] = u[:, :1] * [2, 1j] + 1e-9  # nearly parallel
    got = Model().log_likelihood(Parameters(*X), Measurement(u, v, 0.2))
    assert float(got) == pytest.approx(oracle.log_likelihood(X, u, v, 0.2), abs=1e-9)
    got = Model().log_likelihood(Parameters(*X), Measurement(0 * u, v, 0.2))
    assert float(got) == pytest.approx(oracle.log_likelihood(X, 0 * u, v, 0.2), abs=1e-9)


def test_pixels_states_noise_and_weights_broadcast():
    generator = np.random.default_rng(3)
    u = generator.normal(size=(4, 1, 2, 3)) + 0j
    v = generator.normal(size=(4, 5, 2, 3)) + 0j
    sigma = generator.uniform(0.5, 1, (5,))
    weight = generator.uniform(0.5, 1, (4, 1, 3))
    got = Model().log_likelihood(Parameters(*X), Measurement(u, v, sigma, weight))
    assert got.shape == (4, 5)
    for i, j in ((0, 0), (3, 2)):
        expected = oracle.log_likelihood(X, u[i, 0], v[i, j], sigma[j], weight=weight[i, 0])
        assert float(got[i, j]) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("states", [1, 2, 3, 7])
def test_illuminations_of_their_own_in_every_pixel_give_the_direct_sum(states):
    generator = np.random.default_rng(4)
    u = generator.normal(size=(9, 2, states)) + 1j * generator.normal(size=(9, 2, states))
    u[1] *= 0  # dark
    u[2, 0] = 0  # rank 1
    u[3, 1] = 0
    u[4, 1] = (2 - 1j) * u[4, 0]  # linearly dependent but for rounding
    u[5, 1] = 3 * u[5, 0] + 1e-9 * u[5, 1]  # nearly so
    u[6, 0] = 2j * u[6, 1] + 1e-13 * u[6, 0]
    u[7] *= [[1e-4], [1e4]]
    v = oracle.jones(X) @ u + 0.2 * (generator.normal(size=u.shape) + 1j * generator.normal(size=u.shape)) / 2**0.5
    weight = generator.uniform(0.1, 2, (9, states))
    weight[8, -1] = 0
    got = Model().log_likelihood(Parameters(*X), Measurement(u, v, 0.2, weight))
    for i in range(9):
        expected = oracle.log_likelihood(X, u[i], v[i], 0.2, weight=weight[i])
        assert float(got[i]) == pytest.approx(expected, abs=1e-9, rel=1e-8), i
    summary = summarise(Measurement(u, v, 0.2, weight), np.array(0.2))
    alone = [summarise(Measurement(u[i], v[i], 0.2, weight[i]), np.array(0.2)) for i in range(9)]
    assert summary.rank.tolist() == [int(one.rank) for one in alone]
    assert summary.statistics.count.tolist() == [2.0 * states] * 8 + [2.0 * states - 2]
    for i in (0, 2, 3, 4, 8):
        found, expected = (least_squares_jones(s.statistics) for s in (summary, alone[i]))
        np.testing.assert_allclose(found[i], expected, atol=1e-10)


def test_more_pixels_than_one_block_are_each_in_their_place():
    generator = np.random.default_rng(5)
    shape = (3, 3001)
    u = generator.normal(size=(2, 2)) + 0j
    v = generator.normal(size=(*shape, 2, 2)) + 0j
    sigma = generator.uniform(0.5, 1, shape)
    v[2, 2500, 0, 0] = np.nan
    for many in (u, np.broadcast_to(u, (3, 1, 2, 2)), np.broadcast_to(u, (*shape, 2, 2))):
        got = np.asarray(Model().log_likelihood(Parameters(*X), Measurement(many, v, sigma)))
        assert np.isnan(got).sum() == np.isnan(got[2, 2500]) == 1
        for pixel in ((0, 0), (1, 1700), (2, 3000)):
            expected = oracle.log_likelihood(X, u, v[pixel], sigma[pixel])
            assert got[pixel] == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("scale", [0.05, 1.0, 30.0])
def test_complex_gain_is_the_integral_over_amplitude_and_phase(scale):
    u, v = data(3)

    def density(y, x):
        prior = -(x**2 + y**2) / scale**2 - np.log(np.pi * scale**2)
        return np.exp(oracle.log_likelihood(X, u, v, 0.2, gain=x + 1j * y) + prior - offset)

    offset = oracle.log_likelihood(X, u, v, 0.2)
    m = oracle.jones(X) @ u
    centre = np.vdot(m, v) / (np.vdot(m, m) + 0.04 / scale**2)
    width = 7 * 0.2 / np.sqrt(np.vdot(m, m).real + 0.04 / scale**2)
    nodes, weights = np.polynomial.legendre.leggauss(50)
    value = sum(
        wx * wy * width**2 * density(centre.imag + width * y, centre.real + width * x)
        for x, wx in zip(nodes, weights, strict=True)
        for y, wy in zip(nodes, weights, strict=True)
    )
    got = Model(gain=ComplexGain(scale)).log_likelihood(Parameters(*X), Measurement(u, v, 0.2))
    assert float(got) == pytest.approx(np.log(value) + offset, abs=1e-6)


def test_phase_gain_is_the_integral_over_the_phase():
    u, v = data(3)
    offset = oracle.log_likelihood(X, u, v, 0.2)
    value, _ = integrate.quad(
        lambda a: np.exp(oracle.log_likelihood(X, u, v, 0.2, gain=np.exp(1j * a)) - offset) / (2 * np.pi),
        -np.pi, np.pi, points=[0.0], limit=200,
    )  # fmt: skip
    got = Model(gain=PhaseGain()).log_likelihood(Parameters(*X), Measurement(u, v, 0.2))
    assert float(got) == pytest.approx(np.log(value) + offset, abs=1e-8)


@pytest.mark.parametrize("gain", ["none", "phase", "complex"])
def test_float32_keeps_a_thousandth_of_a_nat_at_high_signal(gain):
    sigma = 1e-4
    u, v = data(3, sigma=0)
    generator = np.random.default_rng(2)
    v = v + sigma * (generator.normal(size=v.shape) + 1j * generator.normal(size=v.shape)) / 2**0.5
    model = Model(gain={"none": None, "phase": PhaseGain(), "complex": ComplexGain(1.0)}[gain])
    single = Measurement(u.astype(np.complex64), v.astype(np.complex64), np.float32(sigma))
    double = Measurement(single.illumination.astype(complex), single.response.astype(complex), float(np.float32(sigma)))
    p32, p64 = Parameters(*map(np.float32, X)), Parameters(*(float(np.float32(x)) for x in X))
    low, high = model.log_likelihood(p32, single), model.log_likelihood(p64, double)
    assert low.dtype == np.float32
    assert float(low) == pytest.approx(float(high), abs=0.05)
    expected = oracle.log_marginal(p64, double.illumination, double.response, sigma, gain, 1.0)
    assert float(high) == pytest.approx(expected, abs=1e-4)


def test_a_dark_pixel_has_a_density_under_every_gain():
    m = Measurement(np.eye(2), np.zeros((2, 2)), 0.1)
    for gain in (None, PhaseGain(), ComplexGain(1.0)):
        assert np.isfinite(Model(gain=gain).log_posterior(Parameters(*X), m))


def test_masked_and_nan_pixels_are_nan_and_alone():
    v = np.ones((3, 2, 2), complex)
    v[1, 0, 0] = np.nan
    values = Model().log_likelihood(Parameters(*X), Measurement(np.eye(2), v, 0.1, mask=np.array([True, True, False])))
    assert np.isnan(values).tolist() == [False, True, True]


def test_an_ordering_without_gain_sees_the_sign_and_bounds_of_the_retardance():
    assert float(Model().log_prior(Parameters(0.0, 0.0, 3.2, 0.0, 0.0))) == -np.inf
    assert np.isfinite(Model(gain=PhaseGain()).log_prior(Parameters(0.0, 0.0, 3.2, 0.0, 0.0)))
    assert Model().bounds["retardance"] == (-np.pi, np.pi)
    assert "retardance" not in Model(gain=PhaseGain()).bounds


def test_parameters_that_drop_out_are_ignored():
    x = Parameters(np.nan, np.nan, 1.0, 0.3, 0.2)
    model = Model(fixed={"diattenuation": 0.0})
    m = Measurement(np.eye(2), np.eye(2), 0.5)
    expected = oracle.log_likelihood((0, 0, 1.0, 0.3, 0.2), np.eye(2), np.eye(2), 0.5)
    assert float(model.log_likelihood(x, m)) == pytest.approx(expected, abs=1e-12)
    assert model.dropped == {"diattenuation_angle"}
    assert Model(fixed={"retardance": 0.0}).dropped == {"retardance_angle", "circularity"}
    assert Model(fixed={"retardance_angle": np.pi / 2}).dropped == {"circularity"}


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: Model(priors={"retardence": None}), ValueError, "unknown parameter 'retardence'"),
        (lambda: Model(fixed={"D": 0.0}), ValueError, "the parameters are diattenuation, "),
        (lambda: Model(fixed={"diattenuation": 1.5}), ValueError, "must be <= 1"),
        (lambda: Model(fixed={"circularity": np.nan}), ValueError, "finite"),
        (lambda: Model(gain=1.0), TypeError, "gain must be Gain"),
        (lambda: Model(ordering=RetarderFirst), TypeError, "ordering must be Ordering"),
        (lambda: Model(noise=0.1), TypeError, "noise must be Noise, got float 0.1; pass KnownNoise"),
        (lambda: ComplexGain(0.0), ValueError, "scale must be > 0"),
        (
            lambda: KnownNoise().sigma(Measurement(np.eye(2), np.eye(2))),
            ValueError,
            "sigma None, but KnownNoise needs it",
        ),
    ],
)
def test_wrong_declarations_are_named(make, error, text):
    with pytest.raises(error, match=text):
        make()


def test_models_are_keys_and_do_not_change():
    model = Model(fixed={"diattenuation": 0.0})
    assert model == Model(fixed={"diattenuation": 0})
    assert len({model, Model(fixed={"diattenuation": 0.0}), Model()}) == 2
    with pytest.raises(TypeError, match="does not change"):
        model.fixed["retardance"] = 1.0


def test_a_von_mises_prior_on_an_axis_is_refused_because_it_is_not_normalised_there():
    from polinfer import VonMises

    with pytest.raises(ValueError, match="AxialVonMises"):
        Model(priors={"retardance_angle": VonMises(0.0, 1.0)})
