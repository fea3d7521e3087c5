"""Convergence is judged by what all equivalent sets share, and the numbers are those of the definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polinfer import ComplexGain, Model, Parameters, PhaseGain, PolariserFirst, orbit
from polinfer.elements import polariser, retarder
from polinfer.sampling.diagnostics import diagnose, effective_sample_size, least_effective, split_r_hat
from polinfer.sampling.invariants import invariants
from tests.polinfer.sampling.made import around, autoregressive, draws_of

FREE_PHASE = Model(gain=PhaseGain())
ANY = st.tuples(
    st.floats(-1, 1), st.floats(-np.pi / 2, np.pi / 2), st.floats(-np.pi, np.pi), st.floats(-np.pi / 2, np.pi / 2),
    st.floats(-np.pi, np.pi),
)  # fmt: skip


@given(ANY)
@settings(max_examples=200, deadline=None)
def test_the_eight_equivalent_sets_have_the_same_invariants(point):
    for model in (Model(), FREE_PHASE):
        for name, values in invariants(model, orbit(Parameters(*point))).items():
            assert np.ptp(values) < 1e-14, name


def test_a_whole_turn_of_the_retardance_changes_nothing_that_a_free_phase_hides():
    p = Parameters(*np.random.default_rng(1).uniform(-1.5, 1.5, (5, 50)))
    turned = p._replace(retardance=p.retardance + 2 * np.pi)
    for name, values in invariants(FREE_PHASE, p).items():
        np.testing.assert_allclose(invariants(FREE_PHASE, turned)[name], values, atol=1e-14, err_msg=name)
    assert np.abs(invariants(Model(), turned)["retarder.w"] - invariants(Model(), p)["retarder.w"]).max() > 1


def test_the_invariants_determine_both_elements():
    """The matrices, formed from the invariants alone, are those of the elements."""
    p = Parameters(*np.random.default_rng(2).uniform(-1, 1, (5, 30)) * np.array([[1], [1.5], [3], [1.5], [3]]))
    found = invariants(Model(), p)
    w, x, y, z = (found[f"retarder.{name}"] for name in "wxyz")
    built = np.array([[w + 1j * x, -z - 1j * y], [z - 1j * y, w - 1j * x]])
    element = np.asarray(retarder(p.retardance, p.retardance_angle, p.circularity))
    np.testing.assert_allclose(np.moveaxis(built, -1, 0), element, atol=2e-6)
    pairs = invariants(FREE_PHASE, p)
    four = {"w": w, "x": x, "y": y, "z": z}
    for name, value in pairs.items():
        if name.startswith("retarder."):
            np.testing.assert_allclose(value, four[name[-2]] * four[name[-1]], atol=1e-15)
    # J J^H of the polariser alone is 1 + D (cos, sin) . (s_z, s_x) in one sign convention or the other
    element = np.asarray(polariser(p.diattenuation, p.diattenuation_angle))
    power = element @ np.conj(np.swapaxes(element, -1, -2))
    np.testing.assert_allclose(0.5 * (power[:, 0, 0] - power[:, 1, 1]).real, found["polariser.cos"], atol=2e-6)
    np.testing.assert_allclose(np.abs(power[:, 0, 1]), np.abs(found["polariser.sin"]), atol=2e-6)
    np.testing.assert_allclose(found["polariser.size"], np.abs(p.diattenuation))


@pytest.mark.parametrize(
    ("fixed", "names"),
    [
        ({"diattenuation": 0.0}, "retarder.w retarder.x retarder.y retarder.z"),
        ({"retardance": 0.0}, "polariser.cos polariser.sin polariser.size"),
        ({"diattenuation": 0.2, "retardance": 0.5, "circularity": 0.0},
         "polariser.cos polariser.sin retarder.x retarder.y"),
        ({"diattenuation_angle": 0.0, "retardance_angle": 0.0},
         "polariser.cos polariser.size retarder.w retarder.x"),
    ],
)  # fmt: skip
def test_what_the_model_keeps_constant_is_left_out(fixed, names):
    nothing = Parameters(*np.full((5, 3), 0.1))
    found = invariants(Model(PolariserFirst(), fixed=fixed), nothing)
    assert set(found) == set(names.split())
    assert all(value.shape == (3,) for value in found.values())


def test_jax_sees_the_same_invariants_and_can_trace_them():
    import jax

    p = Parameters(*np.random.default_rng(3).uniform(-1, 1, (5, 4)).astype(np.float32))
    traced = jax.jit(lambda q: invariants(FREE_PHASE, q))(p)
    for name, value in invariants(FREE_PHASE, p).items():
        np.testing.assert_allclose(traced[name], value, atol=1e-6)


@pytest.mark.parametrize("coefficient", [-0.5, 0.0, 0.5, 0.9])
def test_effective_sample_sizes_of_autoregressive_chains_are_those_of_theory(coefficient):
    """The variance of the mean of AR(1) is that of ``n (1 - a) / (1 + a)`` independent draws."""
    chains, count, repeats = 4, 2000, 200
    values = autoregressive(coefficient, (chains, count, repeats), np.random.default_rng(4))
    expected = chains * count * (1 - coefficient) / (1 + coefficient)
    found = effective_sample_size(values)
    assert found.shape == (repeats,)
    # the mean of 200 estimates that scatter by 10 to 20 %; cutting the sum off biases them by a few per cent
    assert np.median(found) == pytest.approx(expected, rel=0.05)
    # and it is the variance of the mean that they stand for: chi-square of 199 degrees has a spread of 10 %
    assert np.var(values.mean(axis=(0, 1))) * expected == pytest.approx(1, rel=0.4)


def test_split_r_hat_is_the_formula_of_the_book():
    values = np.random.default_rng(5).normal(size=(3, 41)) + np.array([[0.0], [0.3], [0.1]])
    halves = [chain[part] for chain in values for part in (slice(0, 20), slice(21, 41))]  # the middle one is left out
    within = np.mean([np.var(half, ddof=1) for half in halves])
    between = np.var([np.mean(half) for half in halves], ddof=1)
    assert split_r_hat(values) == pytest.approx(np.sqrt((19 / 20 * within + between) / within), rel=1e-12)


def test_a_drift_within_the_chains_is_seen():
    drifting = np.linspace(-1, 1, 500) + 0.1 * np.random.default_rng(6).normal(size=(4, 500))
    assert split_r_hat(drifting) > 1.5
    assert effective_sample_size(drifting) < 20


def test_draws_that_do_not_differ_are_handled():
    steps = np.repeat(np.arange(4.0)[:, None], 100, axis=1)
    assert split_r_hat(steps) == np.inf
    assert split_r_hat(np.full((4, 100), 0.3)) == 1
    assert effective_sample_size(np.full((4, 100), 0.3)) == 400
    assert np.isnan(split_r_hat(np.full((4, 100), np.nan)))
    with pytest.raises(ValueError, match="at least 4 draws"):
        split_r_hat(np.zeros((4, 3)))


@pytest.mark.filterwarnings("ignore")
def test_arviz_finds_the_same_numbers():
    arviz = pytest.importorskip("arviz")
    rng = np.random.default_rng(7)
    for coefficient in (-0.4, 0.0, 0.6, 0.97):
        values = autoregressive(coefficient, (4, 501, 5), rng)
        for k in range(5):
            one = values[:, :, k]
            assert split_r_hat(one) == pytest.approx(float(np.asarray(arviz.rhat(one, method="split"))), rel=1e-10)
            assert effective_sample_size(one) == pytest.approx(
                float(np.asarray(arviz.ess(one, method="mean"))), rel=1e-8
            )


def test_chains_in_different_copies_have_converged_and_chains_in_different_places_have_not():
    p = around((), width=0.02)
    copies = orbit(p)
    spread = Parameters(*(np.stack([x[3 * c % 8, c] for c in range(4)]) for x in copies))
    status = np.zeros((), int)
    assert split_r_hat(spread.retardance) > 3
    told, plain = (diagnose(Model(), q, None, None, status) for q in (spread, p))
    np.testing.assert_allclose(told.r_hat, plain.r_hat, rtol=1e-9)
    np.testing.assert_allclose(told.ess, plain.ess, rtol=1e-9)
    assert told.converged()
    elsewhere = p._replace(retardance=p.retardance + np.array([0, 0, 0, 0.1])[:, None])
    told = diagnose(Model(), elsewhere, None, None, status)
    assert not told.converged()
    assert told.worst_r_hat == told.r_hat[told.names.index("retarder.w")] > 1.5


def test_pixels_are_judged_one_by_one_whatever_the_blocks(monkeypatch):
    status = np.zeros((3, 5), np.int32)
    status[0, 1] = status[2, 2] = 1
    p = around((3, 5), count=101)
    together = diagnose(Model(), p, None, None, status)
    monkeypatch.setattr("polinfer.sampling.blocks.VALUES", 900)
    np.testing.assert_array_equal(diagnose(Model(), p, None, None, status).r_hat, together.r_hat)
    np.testing.assert_array_equal(np.isnan(together.worst_ess), status == 1)
    assert not together.converged()[0, 1]
    alone = diagnose(Model(), Parameters(*(x[..., 2, 4] for x in p)), None, None, np.array(0))
    np.testing.assert_allclose(together.ess[2, 4], alone.ess, rtol=1e-12)


def test_chains_that_never_moved_have_not_converged():
    told = diagnose(Model(), Parameters(*np.full((5, 4, 50), 0.3)), None, None, np.array(0))
    assert np.all(np.isinf(told.r_hat))
    assert told.worst_ess == 1
    # one invariant may stand still to rounding: eta at 0 leaves cos(eta/2) at 1
    p = around((), width=1e-9, centre=(0.3, 0.5, 0.0, 0.4, 0.7))
    told = diagnose(Model(), p, None, None, np.array(0))
    assert told.r_hat[told.names.index("retarder.w")] == 1
    assert told.converged(ess=300)


def test_gain_and_sigma_are_judged_with_the_sign_of_the_gain_left_free():
    rng = np.random.default_rng(8)
    gain = (1 + 0.1 * rng.normal(size=(4, 250, 2))) * np.exp(0.1j * rng.normal(size=(4, 250, 2)))
    signs = np.array([1, -1, 1, -1])[:, None, None]
    sigma = np.exp(0.1 * rng.normal(size=(4, 250, 2)))
    model = Model(gain=ComplexGain(1.0))
    p, status = around((2,)), np.zeros(2, int)
    told = diagnose(model, p, signs * gain, sigma, status)
    assert told.names[-4:] == ("gain.size", "gain.cos", "gain.sin", "sigma")
    assert told.converged().all()
    sigma[0] *= 2
    assert not diagnose(model, p, gain, sigma, status).converged().any()
    assert "gain.size" not in diagnose(FREE_PHASE, p, gain / abs(gain), None, status).names
    dark = gain.copy()
    dark[0, 0, 0] = 0
    assert np.all(np.isfinite(diagnose(model, p, dark, None, status).r_hat))


def test_a_record_says_which_invariant_is_meant(tmp_path):
    import polinfer

    told = draws_of(shape=(2, 3)).diagnostics()
    dataset = told.to_dataset()
    assert dataset["r_hat"].sel(invariant="retarder.w").shape == (2, 3)
    for ending in (".nc", ".zarr"):
        back = polinfer.load(polinfer.save(told, tmp_path / f"told{ending}"))
        np.testing.assert_array_equal(back.ess, told.ess)
        assert back.names == told.names


def test_the_least_number_of_some_functions_is_that_of_all_and_constant_ones_are_passed_over():
    rng = np.random.default_rng(4)
    draws = Parameters(*(0.5 + 0.1 * rng.normal(size=(5, 4, 200, 3))))
    gain = 0.8 + 0.1 * (rng.normal(size=(4, 200, 3)) + 1j * rng.normal(size=(4, 200, 3)))
    model = Model(gain=ComplexGain(1.0))
    whole = diagnose(model, draws, gain, None, np.zeros(3, int))
    every = dict.fromkeys(whole.names, np.array([True, True, False]))
    found = least_effective(model, draws, gain, None, every)
    np.testing.assert_allclose(found[:2], whole.worst_ess[:2])
    assert np.isinf(found[2])
    fixed = Model(gain=ComplexGain(1.0), fixed={"diattenuation": 0.5, "diattenuation_angle": 0.5})
    assert np.isinf(least_effective(fixed, draws, gain, None, {"polariser.size": np.ones(3, bool)})).all()
