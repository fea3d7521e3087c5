"""The closure of the states sees noise, all of it and nothing else."""

import numpy as np
import pytest
import scipy.linalg

from fibre.closure import (
    NoiseScale,
    closure_errors,
    closure_phase_maps,
    closure_phases,
    closure_tilts,
    noise_of_groups,
    noise_scale,
)


def states(n, seed=0):
    generator = np.random.default_rng(seed)
    return generator.normal(size=(2, n)) + 1j * generator.normal(size=(2, n))


def linear_fields(u, count, seed=1):
    """(n, count) fields that depend linearly on the states, of widely different strength."""
    generator = np.random.default_rng(seed)
    response = generator.normal(size=(2, count)) + 1j * generator.normal(size=(2, count))
    return np.einsum("an,ac->nc", u, response * 10 ** generator.uniform(-2, 1, count))


def complex_noise(generator, shape):
    return (generator.normal(size=shape) + 1j * generator.normal(size=shape)) / np.sqrt(2)


@pytest.mark.parametrize("n", [3, 4, 6])
def test_fields_linear_in_the_states_close_exactly(n):
    u = states(n)
    squared, stated, power = closure_errors(linear_fields(u, 50), np.ones((n, 50)), u)
    assert squared.shape == (n - 2, 50)
    assert np.all(squared < 1e-24 * power.max())
    np.testing.assert_allclose(stated, 1)  # coefficients of unit length


def test_a_field_that_is_not_linear_in_the_states_does_not_close():
    u = states(3)
    fields = linear_fields(u, 50)
    fields[1] *= np.exp(0.1j)
    squared, _, power = closure_errors(fields, np.ones((3, 50)), u)
    assert np.median(squared / power) > 1e-4


@pytest.mark.parametrize(("inflation", "relative"), [(1.0, 0.0), (2.5, 0.0), (1.0, 0.03), (3.0, 0.05)])
def test_the_noise_scale_is_found_within_its_own_error(inflation, relative):
    u, count = states(4), 4000
    generator = np.random.default_rng(5)
    clean = linear_fields(u, count)
    stated = generator.uniform(1e-4, 1e-3, clean.shape)
    true = inflation * stated + relative**2 * np.abs(clean) ** 2
    found = []
    for _ in range(8):
        noisy = clean + np.sqrt(true) * complex_noise(generator, clean.shape)
        scale = noise_scale(closure_errors(noisy, stated, u))
        found.append((scale.inflation, scale.relative_error))
    mean, error = np.mean(found, 0), np.std(found, 0, ddof=1) / np.sqrt(8)
    # neither can be negative: at the bound the estimate is a little above it
    assert abs(mean[0] - inflation) < 4 * error[0] + 0.02
    assert abs(mean[1] - relative) < 4 * error[1] + 2e-3


def test_each_polarisation_has_its_own_inflation_and_both_one_relative_error():
    u, count, generator = states(4), 4000, np.random.default_rng(9)
    clean = np.stack([linear_fields(u, count) for _ in range(2)], 1)
    stated = generator.uniform(1e-4, 1e-3, clean.shape)
    true = np.array([8.0, 1.5])[:, None] * stated + 0.02**2 * np.abs(clean) ** 2
    noisy = clean + np.sqrt(true) * complex_noise(generator, clean.shape)
    errors = closure_errors(noisy, stated, u).swapaxes(1, 2).reshape(3, 2, -1)
    scale = noise_scale(errors, by_polarisation=True)
    np.testing.assert_allclose(scale.inflation, [8.0, 1.5], rtol=0.06)
    assert scale.relative_error == pytest.approx(0.02, rel=0.06)
    assert scale.expected(errors).shape == errors[0].shape
    # one for both believes H too much and V too little
    both = noise_scale(errors.reshape(3, -1)).inflation
    assert 2 < both < 7
    np.testing.assert_allclose(np.mean(scale.variance(clean, stated) / true, (0, 2)), 1, atol=0.06)
    assert noise_scale(np.empty((3, 2, 0)), by_polarisation=True).inflation == (1.0, 1.0)


def test_two_states_change_nothing():
    u = states(2)
    errors = closure_errors(linear_fields(u, 30), np.ones((2, 30)), u)
    assert errors.shape == (3, 0, 30)
    assert noise_scale(errors.reshape(3, -1)) == NoiseScale(1.0, 0.0)


def test_quiet_data_never_lower_the_stated_variance():
    u = states(3)
    fields = linear_fields(u, 200)
    scale = noise_scale(closure_errors(fields, np.ones((3, 200)), u))
    assert (scale.inflation, scale.relative_error) == (1.0, 0.0)
    np.testing.assert_array_equal(scale.variance(fields, np.ones((3, 200))), np.ones((3, 200)))


def test_the_variance_is_inflation_times_stated_plus_relative_error_squared_times_power():
    fields = np.array([[3j, 0, 0, 1], [0, 2, 0, 0]])  # mean power 14 / 8
    found = NoiseScale(2.0, 0.1, 0.2).variance(fields, np.full((2, 4), 0.5))
    np.testing.assert_allclose(found, 1 + 0.01 * np.abs(fields) ** 2 + 0.04 * 14 / 8)


def test_light_strayed_into_dark_places_is_told_from_an_error_in_proportion():
    """What belongs to the mean must not be ascribed to bright amplitudes, which would then be believed too little."""
    u, count = states(3), 4000
    generator = np.random.default_rng(6)
    clean = linear_fields(u, count)
    light = np.broadcast_to((np.abs(clean) ** 2).mean(1, keepdims=True), clean.shape)
    noisy = clean + np.sqrt(0.01**2 * np.abs(clean) ** 2 + 0.02**2 * light) * complex_noise(generator, clean.shape)
    errors = closure_errors(noisy, 1e-9 * np.abs(clean) ** 2, u)
    strayed = closure_errors(np.sqrt(light), light, u)[2]
    scale = noise_scale(np.concatenate([errors, strayed[None]]).reshape(4, -1))
    assert scale.relative_error == pytest.approx(0.01, rel=0.15)
    assert scale.stray == pytest.approx(0.02, rel=0.05)
    assert noise_scale(errors.reshape(3, -1)).relative_error > 0.1


def test_phases_are_found_from_any_start():
    """An isolated spot's light comes with any phase in every state, not only with a small one."""
    u, generator = states(3), np.random.default_rng(7)
    clean = linear_fields(u, 30)
    for _ in range(50):
        phases = generator.uniform(-np.pi, np.pi, 3)
        found = closure_phases(np.exp(1j * phases)[:, None] * clean, np.ones(clean.shape), u)
        left = np.exp(1j * (found + phases))
        np.testing.assert_allclose(left / left[0], 1, atol=1e-6)


def test_one_failed_group_neither_sets_the_noise_of_all_nor_is_believed():
    u, generator = states(3), np.random.default_rng(8)

    def errors(noise):
        clean = linear_fields(u, 300)
        noisy = clean + noise * complex_noise(generator, clean.shape)
        return closure_errors(noisy, np.full(clean.shape, 1e-4), u).reshape(3, -1)

    scale, factors = noise_of_groups([errors(0.01) for _ in range(7)] + [errors(0.1)])
    assert scale.inflation < 1.1
    np.testing.assert_array_equal(factors[:7], 1)
    assert factors[7] == pytest.approx(100, rel=0.2)
    # none has failed where all are alike
    assert np.all(noise_of_groups([errors(0.1) for _ in range(5)])[1] == 1)
    assert noise_of_groups([np.empty((3, 0))])[0] == NoiseScale()


@pytest.mark.parametrize("n", [3, 4])
def test_tilts_between_states_are_found_as_well_as_the_noise_allows(n):
    """Against the Cramer-Rao bound of the slopes by a plain numerical Jacobian of the closure sums."""
    generator, u = np.random.default_rng(3), np.stack([np.ones(n), np.exp(2j * np.pi * np.arange(n) / n)]) / 2**0.5
    centres = generator.uniform(-5e-5, 5e-5, (300, 2))
    centres -= centres.mean(0)
    clean = linear_fields(u, 600).reshape(n, 2, 300)
    tilts = generator.normal(scale=3e3, size=(n, 2))
    pistons = generator.normal(scale=0.1, size=n)
    tilts, pistons = tilts - tilts.mean(0), pistons - pistons.mean()
    turned = clean * np.exp(1j * (pistons[:, None] + tilts @ centres.T))[:, None]
    noise = 0.05
    found = [
        closure_tilts(
            turned + noise * complex_noise(generator, turned.shape), np.full(turned.shape, noise**2), u, centres
        )
        for _ in range(40)
    ]
    null = scipy.linalg.null_space(u)

    def sums(parameters):
        ramp = np.exp(1j * (parameters[:n, None] + parameters[n:].reshape(n, 2) @ centres.T))
        return np.einsum("kc,kpm->cpm", null, clean * ramp[:, None]).ravel() / noise

    scale = np.concatenate([np.ones(n), np.full(2 * n, 2e4)])
    jacobian = np.stack([(sums(1e-6 * row) - sums(-1e-6 * row)) / 2e-6 for row in np.diag(scale)], 1)
    bound = np.linalg.pinv(2 * (jacobian.conj().T @ jacobian).real, rcond=1e-9) * np.outer(scale, scale)
    errors = np.array([np.concatenate([p + pistons, (t + tilts).ravel()]) for p, t in found])
    ratio = (errors**2).mean(0) / np.diag(bound)
    # chi-square of 40, within 4 sigma
    assert np.all(np.abs(ratio - 1) < 4 * np.sqrt(2 / 40))


def test_two_states_tell_no_tilt():
    pistons, tilts = closure_tilts(np.ones((2, 5)), np.ones((2, 5)), np.eye(2), np.arange(10.0).reshape(5, 2))
    assert np.all(pistons == 0)
    assert np.all(tilts == 0)


def _over_a_facet(noise, bend, seed=3):
    """Fields of a lattice of fibrelets in three states, captures bent by a slow wave of amplitude ``bend``."""
    rng = np.random.default_rng(seed)
    states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)
    centres = np.stack(np.mgrid[:48, :44], -1).reshape(-1, 2) * 4.5e-6
    response = rng.standard_normal((2, 2, len(centres))) + 1j * rng.standard_normal((2, 2, len(centres)))
    clean = np.einsum("pam,an->npm", response, states)
    wave = np.array([0.2, 0.8, -1.0])[:, None] * bend * np.cos(centres[:, 0] / 60e-6) * np.sin(centres[:, 1] / 70e-6)
    error = rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)
    fields = clean * np.exp(1j * wave)[:, None] + noise * error / np.sqrt(2)
    return fields, np.full(fields.shape, noise**2), states, centres, wave


def test_phases_that_change_over_the_facet_are_found_but_for_what_all_captures_share():
    fields, variance, states, centres, wave = _over_a_facet(0.05, 0.6)
    found = closure_phase_maps(fields, variance, states, centres)
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-6)
    left = found + wave - (found + wave).mean(0)
    inner = np.all((centres > 25e-6) & (centres < centres.max(0) - 25e-6), axis=1)
    # what windows and the interpolation between them, of 22 um and 0.7 of that, smooth away of the wave
    smoothed = 1 - np.exp(-0.5 * 22.5e-6**2 * (1 + 0.7**2) * (1 / 60e-6**2 + 1 / 70e-6**2))
    assert np.std(left[:, inner]) < 1.2 * smoothed * np.std(wave)
    before, after = (closure_errors(f, variance, states)[0].mean() for f in
                     (fields, fields * np.exp(1j * found)[:, None]))  # fmt: skip
    assert before > 20 * 0.05**2
    # phases left over whose sum vanishes enter with 3/2, since the terms that close are 120 degrees apart
    assert after < 1.1 * (0.05**2 + 1.5 * (left**2).mean() * (np.abs(fields) ** 2).mean())


def test_noise_alone_and_two_states_bend_nothing():
    fields, variance, states, centres, _ = _over_a_facet(0.05, 0.0)
    assert np.all(closure_phase_maps(fields, variance, states, centres) == 0)
    assert np.all(closure_phase_maps(fields[:2], variance[:2], states[:, :2], centres) == 0)
    assert np.all(closure_phase_maps(fields[..., :1], variance[..., :1], states, centres[:1]) == 0)
