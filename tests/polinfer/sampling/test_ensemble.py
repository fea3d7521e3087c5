"""The ensemble sampler against closed forms and quadrature in plain NumPy."""

from dataclasses import replace

import numpy as np
import pytest
from emcee import State
from numpy.polynomial.legendre import leggauss
from scipy.special import i0

from polinfer import ComplexGain, InferredNoise, KnownNoise, Measurement, Model, Parameters, PhaseGain, orbit, simulate
from polinfer.sampling import checkpoint
from polinfer.sampling.bridge import Proposal, autocorrelation_time
from polinfer.sampling.charts import copies, log_window, periods
from polinfer.sampling.ensemble import Ensemble, _engine, draw_ensemble
from polinfer.sampling.nuisances import draw_nuisances
from polinfer.statistics import Statistics
from tests.oracles import jones as oracle
from tests.polinfer.scenes import BALANCED, FREE, PRIORS, X, everywhere, with_priors

SIGMA = 0.2
SHORT = Ensemble(walkers=20, warmup=40, thin=2)


def one_pixel():
    return simulate(FREE, Parameters(*X), BALANCED, SIGMA, rng=4)


def vectors(parameters):
    """Numbers that all equivalent copies share: the polariser's vector, its square and the retarder's quaternion."""
    d, td, eta, te, xi = (np.asarray(x, float) for x in parameters)
    c, s = np.cos(eta / 2), np.sin(eta / 2)
    cross = s * np.sin(2 * te)
    return np.stack(
        [d * np.cos(2 * td), d * np.sin(2 * td), d**2, c, s * np.cos(2 * te), cross * np.cos(xi), cross * np.sin(xi)]
    )


def quadrature(data, nodes=24):
    """Evidence, means and variances of :func:`vectors` of one pixel with default priors, unit gain, balanced states.

    |J U|^2 does not depend on J there, so the log likelihood is 2 Re <J, V U^H> / sigma^2 and a constant. The copies
    leave D >= 0 and eta >= 0.
    """
    u, v, sigma = BALANCED, data.response, SIGMA
    x, w = leggauss(nodes)
    unit, half = 0.25 * np.pi * (x + 1), 0.25 * np.pi * w
    circle = np.pi * np.arange(2 * nodes) / (2 * nodes)
    delta, td = (y.ravel() for y in np.meshgrid(unit, circle, indexing="ij"))
    eta, te, xi = (
        y.ravel() for y in np.meshgrid(2 * unit, circle, 2 * np.pi * np.arange(32) / 32 - np.pi, indexing="ij")
    )
    d = np.sin(delta)
    parts = [oracle.polariser(*p) for p in zip(d, td, strict=True)]
    cross = v @ u.conj().T
    # J is linear in the quaternion: four matrices say it all
    units = [np.eye(2), np.diag([1j, -1j]), np.array([[0, -1j], [-1j, 0]]), np.array([[0, -1], [1, 0]])]
    slopes = 2 / sigma**2 * np.array([[np.vdot(p @ q, cross).real for q in units] for p in parts])
    four = vectors((0 * eta, 0 * eta, eta, te, xi))[3:]
    prior_d = np.exp([oracle.log_prior((a, 0, 0, 0, np.pi / 2)) for a in d]) * 2 * np.pi * i0(1.0)
    outer = prior_d * np.cos(delta) * half.repeat(2 * nodes) * np.pi / (2 * nodes)
    inner = (
        np.exp(np.cos(xi)) / (2 * np.pi * i0(1.0)) * (2 * half).repeat(64 * nodes) * np.pi / (2 * nodes) * np.pi / 16
    )
    top = np.max(np.linalg.norm(slopes, axis=1))
    total, sums = 0.0, np.zeros((2, 7))
    for slope, weight, a, b in zip(slopes, outer, d, td, strict=True):
        if np.linalg.norm(slope) < top - 30:
            continue
        weights = weight * inner * np.exp(slope @ four - top)
        own = np.array([a * np.cos(2 * b), a * np.sin(2 * b), a**2])
        mass = weights.sum()
        total += mass
        sums += np.stack([np.concatenate([own**k * mass, four**k @ weights]) for k in (1, 2)])
    constant = -6 * np.log(np.pi * sigma**2) - (np.sum(np.abs(v) ** 2) + np.sum(np.abs(u) ** 2)) / sigma**2
    mean, square = sums / total
    return np.log(4 * total) + top + constant, mean, square - mean**2


def deviations(values, mean, sampler):
    """Differences of means over draws ``(quantity, chain, draw)`` from ``mean``, in standard errors."""
    found = []
    for series, expected in zip(values, mean, strict=True):
        records = series.reshape(series.shape[0], -1, sampler.walkers)
        error = series.std() * np.sqrt(autocorrelation_time(records) / series.size)
        found.append((series.mean() - expected) / error)
    return np.array(found)


def test_the_copies_are_those_of_the_orbit():
    signs, shifts = copies(FREE)
    expected = np.stack(orbit(Parameters(*X)), axis=-1)
    turns = (signs * X + shifts - expected) / np.array([1, np.pi, 2 * np.pi, np.pi, 2 * np.pi])
    assert np.allclose(turns[:, 0], 0)
    assert np.allclose(turns[:, 1:], np.round(turns[:, 1:]))


@pytest.mark.parametrize("gain", [None, PhaseGain()])
def test_shares_of_copies_and_turns_add_up_to_one(gain):
    model, rng = Model(gain=gain), np.random.default_rng(1)
    centre = rng.uniform(-1, 1, 5)
    signs, shifts = copies(model)
    circles = np.flatnonzero(np.isfinite(periods(model)))
    for x in rng.uniform(-1.5, 1.5, (20, 5)):
        total = 0.0
        for sign, shift in zip(signs, shifts, strict=True):
            turns = np.stack(np.meshgrid(*[np.arange(-3, 4)] * len(circles)), axis=-1).reshape(-1, len(circles))
            points = np.tile(sign * x + shift, (len(turns), 1))
            points[:, circles] += turns * periods(model)[circles]
            total += np.exp(log_window(model, centre, points)).sum()
        assert abs(total - 1) < 1e-12


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(Model(**with_priors()), marks=pytest.mark.slow),
        Model(gain=PhaseGain(), **with_priors(diattenuation=0.4)),
    ],
)
def test_without_data_the_draws_follow_the_prior(model):
    data = Measurement(BALANCED, np.zeros((1, 2, 3)), sigma=1e4)
    sampler = Ensemble(walkers=40, warmup=100, thin=8)
    raw = draw_ensemble(model, data, sampler, 3, 2000, 3)
    rng, expected = np.random.default_rng(0), []
    for name in model.free:
        drawn, prior = getattr(raw.parameters, name)[..., 0], PRIORS[name].sample(rng, (400_000,))
        period = 1.0 if name in ("retardance", "circularity", "diattenuation") else 2.0
        for wave in (np.cos, np.sin):
            expected.append(deviations(wave(period * drawn)[None], [wave(period * prior).mean()], sampler)[0])
    assert np.max(np.abs(expected)) < 4.5
    # nothing but the noise's own density is left
    assert abs(raw.log_evidence[0] + 6 * np.log(np.pi * 1e8)) < 4 * raw.log_evidence_error[0] + 1e-6
    assert raw.log_evidence_error[0] < 0.1
    assert raw.converged.all()


def test_the_moves_keep_a_known_density():
    scale = np.array([1.0, 0.1, 3.0])

    def target(x):
        return -0.5 * np.sum((x / scale) ** 2, axis=-1)

    def draw(rng, count):
        return 4 * scale * rng.normal(size=(count, 3))

    def density(x):
        return target(x / 4) - 1.5 * np.log(2 * np.pi) - np.log(64 * scale.prod())

    rng = np.random.default_rng(4)
    proposal = Proposal(np.ones(1), np.full((1, 3), 0.05), np.diag(scale)[None], 0.2, draw, density)
    start = State(rng.normal(size=(40, 3)) * scale, random_state=np.random.RandomState(2).get_state())
    steps = [s.coords / scale for s in _engine(target, proposal, (40, 3)).sample(start, iterations=5000, store=False)]
    for power, expected in ((1, 0), (2, 1), (4, 3)):
        series = np.array(steps) ** power
        for k in range(3):
            error = series[..., k].std() * np.sqrt(autocorrelation_time(series[None, ..., k]) / series[..., k].size)
            assert error < 0.05
            assert abs(series[..., k].mean() - expected) < 4.5 * error


def test_moments_and_evidence_agree_with_quadrature():
    data = one_pixel()
    evidence, mean, variance = quadrature(data)
    assert abs(quadrature(data, 20)[0] - evidence) < 1e-3  # the quadrature itself
    sampler = Ensemble()
    raw = draw_ensemble(FREE, data, sampler, 4, 1600, 11)
    drawn = vectors(Parameters(*(x[..., 0] for x in raw.parameters)))
    assert np.max(np.abs(deviations(drawn, mean, sampler))) < 4.5
    squares = (drawn - mean[:, None, None]) ** 2
    assert np.max(np.abs(deviations(squares, variance, sampler))) < 4.5
    assert abs(raw.log_evidence[0] - evidence) < 4 * raw.log_evidence_error[0]
    assert raw.log_evidence_error[0] < 0.05
    assert raw.converged.all()
    # the two sides of the circularity, whose prior is e^cos xi
    share = np.mean(np.abs(raw.parameters.circularity) > np.pi / 2)
    assert 0.02 < share < 0.4


def test_an_interrupted_run_goes_on_to_the_same_result(tmp_path, monkeypatch):
    data, sampler = one_pixel(), replace(SHORT, backend=str(tmp_path / "state"))
    whole = draw_ensemble(FREE, data, SHORT, 2, 200, 7)
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    written, write = [], checkpoint.Checkpoint.write

    def stop(self, *args, **kwargs):
        write(self, *args, **kwargs)
        written.append(self.path)
        if len(written) == 14:  # in the second ensemble
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint.Checkpoint, "write", stop)
    with pytest.raises(KeyboardInterrupt):
        draw_ensemble(FREE, data, sampler, 2, 200, 7)
    again = draw_ensemble(FREE, data, sampler, 2, 200, 7)
    assert len(written) == 20
    for a, b in zip(again.parameters, whole.parameters, strict=True):
        assert np.array_equal(a, b)
    assert np.array_equal(again.log_evidence, whole.log_evidence, equal_nan=True)
    with pytest.raises(ValueError, match=r"backend: .* belongs to another"):
        draw_ensemble(FREE, replace(data, sigma=np.array(0.3)), sampler, 2, 200, 7)
    written[0].write_bytes(b"PK nothing")
    with pytest.raises(ValueError, match=r"backend: .* is damaged"):
        draw_ensemble(FREE, data, sampler, 2, 200, 7)


def test_the_draws_of_a_pixel_do_not_depend_on_the_others():
    data = simulate(FREE, everywhere(3, X), BALANCED, SIGMA, rng=5)
    frame = draw_ensemble(FREE, data, SHORT, 2, 60, 9)
    alone = draw_ensemble(FREE, replace(data, mask=np.array([False, True, False])), SHORT, 2, 60, 9)
    chosen = draw_ensemble(FREE, data, SHORT, 2, 60, 9, good=np.array([1]))
    for whole, one, other in zip(frame.parameters, alone.parameters, chosen.parameters, strict=True):
        assert np.array_equal(whole[..., 1:2], one)
        assert np.array_equal(one, other)
        assert not np.array_equal(whole[..., 0], whole[..., 1])
    assert not np.array_equal(alone.parameters.retardance[0], alone.parameters.retardance[1])


@pytest.mark.parametrize("gain", [None, PhaseGain(), ComplexGain(0.8)])
@pytest.mark.parametrize("noise", [KnownNoise(), InferredNoise(1.5, 0.3, "pixel")])
def test_gain_and_sigma_follow_their_density_given_the_matrix(gain, noise):
    inferred, rng = noise != KnownNoise(), np.random.default_rng(8)
    matrix = oracle.jones(X)
    response = 0.6 * np.exp(0.7j) * matrix @ BALANCED + 0.4 * (rng.normal(size=(2, 3)) + 1j * rng.normal(size=(2, 3)))
    # two states in place of three, which is all that the statistics keep
    left, values, right = np.linalg.svd(BALANCED, full_matrices=False)
    root, projected = left * values, response @ right.conj().T
    residual = np.sum(np.abs(response) ** 2) - np.sum(np.abs(projected) ** 2)
    own = Statistics(root, projected, residual, 0.0, 6.0)
    count = 30_000
    drawn, sigma = draw_nuisances(Model(gain=gain, noise=noise), own, np.tile(matrix, (count, 1, 1)), rng)
    # brute force: a grid over phase, amplitude and log variance
    phase = np.linspace(-np.pi, np.pi, 100, endpoint=False)
    amplitude = np.linspace(0.01, 3, 100) if isinstance(gain, ComplexGain) else np.ones(1)
    variance = np.exp(np.linspace(-5, 5, 120)) if inferred else np.ones(1)
    if gain is None:
        phase = np.zeros(1)
    r, p, s = np.meshgrid(amplitude, phase, variance, indexing="ij")
    g = r * np.exp(1j * p)
    overlap = np.vdot(matrix @ BALANCED, response)
    square = np.sum(np.abs(response) ** 2) + r**2 * np.sum(np.abs(matrix @ BALANCED) ** 2)
    square = square - 2 * (np.conj(g) * overlap).real
    logs = -square / s - 6 * np.log(s)
    if inferred:
        logs += -noise.shape * np.log(s) - noise.scale / s
    if isinstance(gain, ComplexGain):
        logs += np.log(r) - r**2 / gain.scale**2
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    pairs = []
    if gain is None:
        assert drawn is None
    else:
        pairs += [(drawn.real, g.real), (drawn.imag, g.imag), (drawn.real**2, g.real**2), (np.abs(drawn), r)]
    if inferred:
        pairs += [(sigma, s**0.5), (np.log(sigma), 0.5 * np.log(s))]
    else:
        assert sigma is None
    if gain is not None and inferred:
        pairs.append((np.log(sigma) * drawn.real, 0.5 * np.log(s) * g.real))
    for found, grid in pairs:
        expected = np.sum(weights * grid)
        assert abs(found.mean() - expected) < 4.5 * found.std() / np.sqrt(count) + 2e-4


@pytest.mark.slow
def test_walkers_that_have_not_mixed_give_no_evidence():
    # one state of light leaves two of the five parameters open: a curved ridge, along which walkers are slow
    model = Model(gain=PhaseGain())
    data = simulate(model, everywhere(1, X), BALANCED[:, :1], 0.05, rng=3)
    raw = draw_ensemble(model, data, Ensemble(walkers=20, warmup=50, thin=5), 2, 320, 1)
    assert not raw.converged[0]
    assert np.isnan(raw.log_evidence[0])
    assert np.isnan(raw.log_evidence_error[0])
    assert all(np.isfinite(x).all() for x in raw.parameters)


def test_mistakes_are_named():
    data = one_pixel()
    with pytest.raises(ValueError, match="walkers must be even"):
        Ensemble(walkers=21)
    with pytest.raises(ValueError, match="thin must be >= 1"):
        Ensemble(thin=0)
    with pytest.raises(TypeError, match="backend must be"):
        Ensemble(backend=3)
    with pytest.raises(ValueError, match="walkers must be at least 10"):
        draw_ensemble(FREE, data, Ensemble(walkers=8), 1, 10, 0)
    frame = Model(noise=InferredNoise(1.0, 1.0, "frame"))
    with pytest.raises(ValueError, match="use Gibbs"):
        draw_ensemble(frame, replace(data, sigma=None), SHORT, 1, 10, 0)
    known = dict(zip(Parameters._fields, X, strict=True))
    with pytest.raises(ValueError, match="no free parameter"):
        draw_ensemble(Model(fixed=known), data, SHORT, 1, 10, 0)
