"""The parts of the fast route are the formulas that they stand for."""

from functools import cache
from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polinfer
from polinfer import (
    AxialVonMises,
    Model,
    Parameters,
    PhaseGain,
    TruncatedNormal,
    UniformAngle,
    VonMises,
)
from polinfer.fitting.fast import climb, data, describe, linear, overlap, point, priors, scene, start
from polinfer.statistics import Statistics
from tests.oracles import jones as oracle
from tests.polinfer.scenes import (
    GAINS,
    ORDERINGS,
    PRIORS,
)

FLAT = {"diattenuation": UniformAngle(2.0), "circularity": UniformAngle(2 * pi)}


def random_angles(count, seed):
    """Angles y (5, count) in the interior of their ranges."""
    limits = np.array([0.24 * pi, pi, 0.48 * pi, pi, pi])
    return np.random.default_rng(seed).uniform(-1, 1, (5, count)) * limits[:, None]


def random_matrix(count, seed):
    pair = np.random.default_rng(seed).normal(size=(2, count, 2, 2))
    return pair[0] + 1j * pair[1]


def as_point(y):
    return point.Point(*((np.cos(x), np.sin(x)) for x in y))


def as_parameters(y):
    return Parameters(jnp.sin(2 * y[0]), y[1] / 2, 2 * y[2], y[3] / 2, y[4])


def as_parts(matrix):
    return [[(matrix[..., i, j].real, matrix[..., i, j].imag) for j in (0, 1)] for i in (0, 1)]


def products(ordering, y):
    """J as the product of seven matrices, in JAX for the sake of its derivatives."""
    d, td, eta, te, xi = as_parameters(y)

    def rotation(t):
        return jnp.array([[jnp.cos(t), jnp.sin(t)], [-jnp.sin(t), jnp.cos(t)]])

    pol = rotation(td) @ jnp.diag(jnp.array([jnp.sqrt(1 + d), jnp.sqrt(1 - d)])) @ rotation(-td)
    ret = rotation(te) @ jnp.diag(jnp.array([jnp.exp(0.5j * eta), jnp.exp(-0.5j * eta)])) @ rotation(-te)
    turn = jnp.exp(1j * xi)
    ret = jnp.diag(jnp.array([1, turn])) @ ret @ jnp.diag(jnp.array([1, 1 / turn]))
    return pol @ ret if ordering == "retarder_first" else ret @ pol


@cache
def reference(ordering):
    """Value, gradient and Hessian by y of Re tr(J^H K) and |J R|^2, for arrays of pixels."""

    def both(y, k, r):
        j = products(ordering, y)
        return jnp.stack([jnp.sum(jnp.conj(j) * k).real, jnp.sum(jnp.abs(j @ r) ** 2)])

    return jax.jit(jax.vmap(lambda *x: (both(*x), jax.jacfwd(both)(*x), jax.jacfwd(jax.jacfwd(both))(*x))))


def compare(found, value, gradient, hessian, rtol, free=range(5)):
    """Every entry, relative to the largest of its kind in the pixel."""
    free = list(free)
    np.testing.assert_allclose(found[0], value, rtol=rtol, atol=rtol * np.abs(value).max())
    ours = np.stack([found[1][i] + np.zeros_like(value) for i in free], axis=-1)
    theirs = gradient[..., free]
    assert np.max(np.abs(ours - theirs) / np.abs(theirs).max(axis=-1, keepdims=True)) < rtol
    bent = {(i, j): found[2].get((i, j), found[2].get((j, i), 0)) for i in free for j in free}
    for i in free:
        for j in free:
            off = np.abs(bent[i, j] - hessian[..., i, j]) / np.abs(hessian).max(axis=(-1, -2))
            assert np.max(off) < rtol, (i, j)


@pytest.mark.parametrize("ordering", ORDERINGS)
def test_overlap_and_energy_have_the_derivatives_of_the_matrix_products(ordering):
    y, k, r = random_angles(40, 1), random_matrix(40, 2), random_matrix(40, 3)
    retarder_first = ordering == "retarder_first"
    values, gradients, hessians = (np.asarray(x) for x in reference(ordering)(y.T, k, r))
    table = overlap.coefficients(retarder_first, overlap.pauli(as_parts(k)))
    found = overlap.overlap(table, as_point(y), 1.0)
    compare(found, values[:, 0], gradients[:, 0], hessians[:, 0], 1e-12)
    value, slopes = overlap.overlap_slopes(table, as_point(y))
    np.testing.assert_allclose(value, found.value)
    np.testing.assert_allclose(np.stack(slopes), np.stack(found.gradient))
    power = overlap.pauli(as_parts(r @ r.conj().swapaxes(-1, -2)))
    compare(overlap.energy(retarder_first, power, as_point(y)), values[:, 1], gradients[:, 1], hessians[:, 1], 1e-12)


@pytest.mark.parametrize("ordering", ORDERINGS)
def test_the_matrix_of_a_point_is_the_product_of_the_elements(ordering):
    y = random_angles(20, 4)
    u, q = point.polariser_vectors(as_point(y))[0], point.retarder_vectors(as_point(y))[0]
    found = point.matrix(ordering == "retarder_first", u, q)
    x = np.stack([np.asarray(v) for v in as_parameters(y)])
    for i in range(20):
        expected = oracle.jones(x[:, i], ordering)
        ours = np.array([[found[a][b][0][i] + 1j * found[a][b][1][i] for b in (0, 1)] for a in (0, 1)])
        np.testing.assert_allclose(ours, expected, atol=1e-13)


def test_turning_by_a_step_moves_an_angle_by_the_step_and_restores_the_length():
    angle, step = np.linspace(-3, 3, 7)[:, None], np.array([-0.7, -1e-3, 0.0, 0.2, 0.7])
    long = 1 + 1e-6
    c, s = point.rotate((long * np.cos(angle), long * np.sin(angle)), step)
    np.testing.assert_allclose(np.hypot(c, s), 1, atol=2e-12)
    np.testing.assert_allclose(np.arctan2(s, c), np.angle(np.exp(1j * (angle + 2 * np.arctan(step / 2)))), atol=1e-12)


def statistics_of(count, seed, strength, balanced):
    """R and Y of pixels with the given |Y| (count,); some of Y fits the parameters and some does not."""
    root = random_matrix(count, seed)
    if balanced:
        root = np.linalg.qr(root)[0]
    size = strength[:, None, None] / 2
    rng = np.random.default_rng(seed + 1)
    return Statistics(
        root * size, random_matrix(count, seed + 2) * size, rng.uniform(0, 5, count), rng.normal(size=count),
        np.full(count, 6.0),
    )  # fmt: skip


def prepared(statistics, balanced):
    return data.prepare(
        balanced, as_parts(statistics.illumination), as_parts(statistics.response), statistics.residual,
        statistics.constant, 1.0,
    )  # fmt: skip


def density_derivatives(model):
    def density(y, one):
        return model.log_density(as_parameters(y), one)

    every = jax.vmap(lambda *x: (density(*x), jax.grad(density)(*x), jax.hessian(density)(*x)))
    return jax.jit(every)


@pytest.mark.parametrize(
    ("ordering", "gain", "chosen", "fixed", "balanced"),
    [
        ("retarder_first", "none", {}, {"diattenuation": 0.3}, False),
        ("retarder_first", "complex", PRIORS, {}, False),
        ("polariser_first", "none", PRIORS, {}, True),
        pytest.param("polariser_first", "phase", PRIORS, {}, False, marks=pytest.mark.slow),
        ("polariser_first", "complex", {}, {"diattenuation_angle": 0.4}, False),
    ],
)
def test_derivatives_of_the_log_posterior_are_those_of_the_model(ordering, gain, chosen, fixed, balanced):
    model = Model(ORDERINGS[ordering], {k: v for k, v in chosen.items() if k not in fixed}, gain=GAINS[gain],
                  fixed=fixed)  # fmt: skip
    known = scene.scene(model)
    count = 60
    strength = np.logspace(-2, 3, count)
    statistics = statistics_of(count, 5, strength, balanced)
    y = random_angles(count, 6)
    for i, pair in enumerate(known.fixed):
        if pair is not None:
            y[i] = np.arctan2(pair[1].value, pair[0].value)
    expected = [np.asarray(x) for x in density_derivatives(model)(y.T, statistics)]
    here = as_point(y)
    for flag in (False, True) if balanced else (False,):
        known_data = prepared(statistics, flag)
        value, at = climb.evaluate(known, known_data, here)
        likelihood = climb.derivatives(known, flag, known_data, here, at)
        whole = climb.with_prior(known.prior, here, likelihood)
        # beyond x = 20 the second derivative of log I_0(x) is a series of three terms, right to 1.6/x^3 of itself; at
        # most about one part in x of the Hessian is due to it
        compare((value, whole.gradient, whole.hessian), *expected, 1e-5 if gain == "phase" else 1e-10, known.free)


@pytest.mark.parametrize("name", Parameters._fields)
def test_priors_and_their_derivatives_are_those_of_the_densities(name):
    given = {
        "diattenuation": [TruncatedNormal(0.0, 0.5, -1, 1), TruncatedNormal(-0.3, 0.2, -1, 1),
                          TruncatedNormal(1.4, 0.3, -1, 1), UniformAngle(2.0)],
        "diattenuation_angle": [UniformAngle(pi), AxialVonMises(0.4, 3.0), AxialVonMises(-7.0, 200.0)],
        "retardance": [UniformAngle(2 * pi), VonMises(2.0, 3.0), AxialVonMises(0.7, 2.0)],
        "retardance_angle": [UniformAngle(pi), AxialVonMises(-1.5, 0.3)],
        "circularity": [UniformAngle(2 * pi), VonMises(0.0, 1.0), VonMises(-2.5, 40.0), AxialVonMises(1.0, 5.0)],
    }[name]  # fmt: skip
    i = Parameters._fields.index(name)
    y = random_angles(50, 7)[i]
    pair = (np.cos(y), np.sin(y))
    for prior in given:

        def log_density(x, prior=prior):
            return prior.log_density(as_parameters([x] * 5)[i])

        slope = jax.grad(log_density)
        every = jax.jit(jax.vmap(lambda x, f=log_density, g=slope: (f(x), g(x), jax.grad(g)(x))))
        value, slope, bend = (np.asarray(x) for x in every(y))
        term = priors.term(name, prior)
        found = term.evaluate(pair) or (0.0, 0.0, 0.0)
        np.testing.assert_allclose(term.constant + found[0], value, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(found[1] + 0 * y, slope, rtol=1e-10, atol=1e-10 * (1 + np.abs(slope).max()))
        np.testing.assert_allclose(found[2] + 0 * y, bend, rtol=1e-10, atol=1e-10 * (1 + np.abs(bend).max()))


@pytest.mark.parametrize(
    ("name", "prior"),
    [
        ("diattenuation", TruncatedNormal(0.0, 0.5, -0.9, 1.0)),
        ("diattenuation", UniformAngle(1.0)),
        ("diattenuation", VonMises(0.0, 1.0)),
        ("retardance", UniformAngle(pi)),
        ("retardance", TruncatedNormal(0.0, 1.0, -pi, pi)),
        ("circularity", UniformAngle(1.0)),
    ],
)
def test_priors_without_such_a_form_are_left_to_the_general_route(name, prior):
    assert priors.term(name, prior) is None


def test_transformed_priors_are_those_of_the_equivalent_parameters():
    model = Model(priors=PRIORS, gain=PhaseGain())
    prior = scene.scene(model).prior
    y = random_angles(30, 8)
    copies = polinfer.orbit(Parameters(*(np.asarray(x) for x in as_parameters(y))))
    constant = sum(term.constant for term in prior)
    for k, copy in enumerate(priors.COPIES):
        seen = tuple(term.transformed(*move) for term, move in zip(prior, copy, strict=True))
        expected = sum(PRIORS[name].log_density(getattr(copies, name)[k]) for name in Parameters._fields)
        np.testing.assert_allclose(constant + priors.log_prior(seen, as_point(y)), expected, atol=1e-12)
        there = climb.moved(copy, as_point(y))
        np.testing.assert_allclose(priors.log_prior(prior, there), priors.log_prior(seen, as_point(y)), atol=1e-12)
        own = Parameters(*(x[k] for x in copies))
        np.testing.assert_allclose(2 * there.diattenuation[0] * there.diattenuation[1], own.diattenuation, atol=1e-12)
        for name in Parameters._fields[1:]:
            c, s = getattr(there, name)
            factor = getattr(priors.FACTORS, name)
            turn = np.exp(1j * factor * getattr(own, name))
            # retardances 2 pi apart are one point where the phase is free, and of opposite sign where it is not
            np.testing.assert_allclose(c + 1j * s, turn, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_written_out_factorisation_solves_and_inverts(n):
    rng = np.random.default_rng(n)
    root = rng.normal(size=(30, n, n + 1))
    a = root @ root.swapaxes(-1, -2) + 0.1 * np.eye(n)
    b = rng.normal(size=(30, n))
    triangle = {(i, j): a[:, i, j] for i in range(n) for j in range(i, n)}
    found = linear.factorise(triangle, n)
    lower, smallest = found.lower, found.smallest
    expected = np.linalg.cholesky(a)
    for (i, j), value in lower.items():
        np.testing.assert_allclose(value, expected[:, i, j], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(smallest, np.min(np.einsum("pii->pi", expected), axis=1) ** 2, rtol=1e-9)
    x, power = linear.solve(lower, list(b.T))
    np.testing.assert_allclose(np.stack(x, axis=-1), np.linalg.solve(a, b[..., None])[..., 0], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(power, np.einsum("pi,pi->p", b, np.stack(x, axis=-1)), rtol=1e-8)
    inverse = linear.inverse(lower, n)
    full = np.linalg.inv(a)
    assert set(inverse) == set(triangle)
    for (i, j), value in inverse.items():
        np.testing.assert_allclose(value, full[:, i, j], rtol=1e-8, atol=1e-9)


def test_an_indefinite_matrix_with_a_floor_still_gives_a_way_uphill():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(200, 4, 4))
    a = a + a.swapaxes(-1, -2) + 2.5 * np.eye(4)
    gradient = rng.normal(size=(200, 4))
    found = linear.factorise({(i, j): a[:, i, j] for i in range(4) for j in range(i, 4)}, 4, 1e-6)
    lower, smallest = found.lower, found.smallest
    positive = np.linalg.eigvalsh(a).min(axis=1) > 0
    np.testing.assert_array_equal(smallest > 0, positive)
    assert 0 < positive.sum() < 100
    step, power = linear.solve(lower, list(gradient.T))
    np.testing.assert_allclose(np.einsum("pi,ip->p", gradient, np.stack(step)), power, rtol=1e-6)
    assert (power > 0).all()


def ordered(ordering, x):
    return np.stack([oracle.jones(one, ordering) for one in x.T])


@pytest.mark.parametrize("gain", ["none", "phase"])
@pytest.mark.parametrize("ordering", ORDERINGS)
def test_the_closed_form_of_a_matrix_without_noise_is_exact(ordering, gain):
    rng = np.random.default_rng(9)
    x = rng.uniform(-1, 1, (5, 200)) * np.array([0.99, pi / 2, pi, pi / 2, pi])[:, None]
    special = np.array(np.meshgrid([0.0, 1e-9, -0.6], [0.0, pi / 2], [0.0, 1e-9, pi, -pi], [0.0, pi / 4, pi / 2],
                                   [0.0, pi / 2])).reshape(5, -1)  # fmt: skip
    x = np.concatenate([x, special], axis=1)
    matrices = ordered(ordering, x)
    root = random_matrix(x.shape[1], 10)
    phase = np.exp(1j * rng.uniform(-pi, pi, x.shape[1]))[:, None, None] if gain == "phase" else 1.0
    known = scene.scene(Model(ORDERINGS[ordering], gain=GAINS[gain]))
    nothing = np.zeros(x.shape[1])
    for balanced, seen in ((False, root), (True, np.broadcast_to(3.0 * np.eye(2), root.shape))):
        statistics = Statistics(seen, phase * matrices @ seen, nothing, nothing, nothing)
        found = start.closed_form(known, prepared(statistics, balanced))
        assert (np.asarray(found.circularity[0]) >= 0).all()  # of the two copies the one that the default prior likes
        u, q = point.polariser_vectors(found)[0], point.retarder_vectors(found)[0]
        parts = point.matrix(ordering == "retarder_first", u, q)
        ours = np.stack([np.stack([np.asarray(a + 1j * b) for a, b in row], -1) for row in parts], -2)
        overlap_phase = np.sum(np.conj(ours) * matrices, axis=(-1, -2))
        turn = overlap_phase / np.abs(overlap_phase) if gain == "phase" else np.ones(len(ours))
        # the polariser's axis at D = 1e-9 is the square root of the rounding of the matrix
        np.testing.assert_allclose(turn[:, None, None] * ours, matrices, atol=1e-7)
        np.testing.assert_allclose((turn[:, None, None] * ours)[:200], matrices[:200], atol=1e-10)


def test_fixed_angles_are_in_place_in_the_closed_form():
    model = Model(fixed={"diattenuation": -0.4, "diattenuation_angle": 0.3})
    known = scene.scene(model)
    statistics = Statistics(random_matrix(5, 1), random_matrix(5, 2), *(np.zeros(5) for _ in range(3)))
    found = start.closed_form(known, prepared(statistics, False))
    assert found.diattenuation == known.fixed[0]
    (c, s), (x, y) = ([part.value for part in pair] for pair in known.fixed[:2])
    np.testing.assert_allclose(2 * c * s, -0.4)
    np.testing.assert_allclose(np.arctan2(y, x), 0.6)


@pytest.mark.parametrize("gain", ["none", "phase"])
def test_with_flat_priors_the_copy_reported_is_the_canonical_one(gain):
    known = scene.scene(Model(priors=FLAT, gain=GAINS[gain]))
    rng = np.random.default_rng(11)
    x = rng.uniform(-1, 1, (5, 500)) * np.array([1, pi / 2, pi, pi / 2, pi])[:, None]
    special = np.array(np.meshgrid([0.0, 0.5, 1.0], [0.0, pi / 4, pi / 2], [0.0, 1.0, pi], [0.0, pi / 4, pi / 2],
                                   [0.0, pi / 2, pi])).reshape(5, -1)  # fmt: skip
    expected = np.stack(polinfer.canonicalise(Parameters(*np.concatenate([x, special], axis=1))))
    copies = polinfer.orbit(Parameters(*np.concatenate([x, special], axis=1)))
    for k in range(8):
        own = Parameters(*(value[k] for value in copies))
        angles = [
            0.5 * np.arcsin(own.diattenuation),
            *(f * v for f, v in zip(priors.FACTORS[1:], own[1:], strict=True)),
        ]
        here = as_point(angles)
        found, signs = describe._choose(known, 1.0, here, describe._values(known, 1.0, here))
        np.testing.assert_allclose(np.stack([np.asarray(v) for v in found]), expected, atol=1e-12, err_msg=str(k))
        # the sign of a parameter is how it changes with the angle that it was found at
        change = np.stack([signs[i] * np.ones(own.diattenuation.shape) for i in range(5)])
        moved = as_point(np.stack(angles)[:, :500] + 1e-5)
        near, _ = describe._choose(known, 1.0, moved, describe._values(known, 1.0, moved))
        step = np.stack([np.asarray(v) for v in near]) - np.stack([np.asarray(v) for v in found])[:, :500]
        sure = (np.abs(step) < 1e-3).all(axis=0)
        assert sure.mean() > 0.95
        np.testing.assert_array_equal(np.sign(step[:, sure]), change[:, :500][:, sure])
