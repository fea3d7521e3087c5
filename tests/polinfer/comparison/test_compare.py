"""Comparisons of fits and draws: evidences, what is pooled, what is refused, and what a scene needs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import polinfer
from polinfer import InferredNoise, Measurement, Model, Parameters, PolariserFirst, RetarderFirst, VonMises, Window
from polinfer.comparison import compare, power, select
from polinfer.records import Status

STATES = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
ORDERINGS = {"retarder_first": Model(), "polariser_first": Model(PolariserFirst())}
RETARDER = Model(fixed={"diattenuation": 0.0})


def anywhere(shape, diattenuation, seed=0):
    """Parameters from the default priors, but for D."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-0.5, 0.5, (3, *shape)) * np.pi
    d = np.broadcast_to(diattenuation, shape)
    return Parameters(d, turn[0], 2 * turn[1], turn[2], VonMises(0.0, 1.0).sample(rng, shape))


def measured(model=ORDERINGS["retarder_first"], shape=(4, 16), diattenuation=0.3, sigma=0.05, seed=0):
    return polinfer.simulate(model, anywhere(shape, diattenuation, seed), STATES, sigma, rng=seed + 1)


def fitted(data, models=ORDERINGS):
    return {name: polinfer.fit(model, data) for name, model in models.items()}


@pytest.mark.parametrize("truth", list(ORDERINGS))
def test_the_ordering_that_made_the_data_is_found_and_the_numbers_are_those_of_the_fits(truth):
    fits = fitted(measured(ORDERINGS[truth]))
    found = compare(fits)
    assert found.verdict == truth
    evidence = np.stack([f.log_evidence for f in fits.values()])
    np.testing.assert_array_equal(found.log_evidence, evidence)
    np.testing.assert_allclose(found.pooled, evidence.sum(axis=(1, 2)))
    np.testing.assert_allclose(found.probabilities[0], 1 / (1 + np.exp(evidence[1] - evidence[0])), atol=1e-12)
    factor, error = found.bayes_factor(*ORDERINGS)
    np.testing.assert_allclose(factor, evidence[0] - evidence[1])
    assert np.isnan(error).all()
    lead, error, scatter = found.scene.bayes_factor(*ORDERINGS)
    assert lead == pytest.approx(factor.sum())
    assert np.isnan(error)
    assert scatter == pytest.approx(factor.std(ddof=1) * 64**0.5)
    sure = found.probabilities.max(axis=0) >= 0.95
    np.testing.assert_array_equal(found.pixel_verdict == "undecided", ~sure)
    assert set(found.pixel_verdict[sure]) <= set(ORDERINGS)


def test_a_transposed_matrix_has_the_reverse_ordering():
    """(A_pol A_ret)^T = A_ret(-xi) A_pol, and the prior of xi is even: the evidences change places."""
    jones = measured().response @ STATES.conj().T / 1.5
    one, other = (compare(fitted(Measurement(STATES, m @ STATES, 0.05))) for m in (jones, jones.swapaxes(-1, -2)))
    np.testing.assert_allclose(one.log_evidence, other.log_evidence[::-1], atol=1e-6)
    assert {one.verdict, other.verdict} == set(ORDERINGS)


def test_without_diattenuation_both_orderings_are_one_model():
    models = {k: Model(o, fixed={"diattenuation": 0.0}) for k, o in (("a", RetarderFirst()), ("b", PolariserFirst()))}
    found = compare(fitted(measured(diattenuation=0.0), models))
    np.testing.assert_allclose(found.log_evidence[0], found.log_evidence[1], atol=1e-9)
    np.testing.assert_allclose(found.pooled_probabilities, 0.5, atol=1e-6)
    assert found.verdict == "undecided"
    assert set(found.pixel_verdict.ravel()) == {"undecided"}


def test_prior_probabilities_multiply_the_evidences():
    fits = fitted(measured(diattenuation=0.1))
    even = compare(fits)
    skew = compare(fits, prior={"polariser_first": 0.9, "retarder_first": 0.1})
    odds = even.probabilities[1] / even.probabilities[0]
    np.testing.assert_allclose(skew.probabilities[1] / skew.probabilities[0], 9 * odds)
    with pytest.raises(ValueError, match="sum to 1"):
        compare(fits, prior={"polariser_first": 0.9, "retarder_first": 0.2})
    with pytest.raises(ValueError, match="must name"):
        compare(fits, prior={"polariser_first": 1.0})


def test_pixels_without_an_answer_are_left_out_and_flagged_ones_are_not():
    data = measured()
    mask = np.ones(data.shape, bool)
    mask[0] = False
    fits = fitted(replace(data, mask=mask))
    status = fits["retarder_first"].status.copy()
    status[1, 0] |= int(Status.NOT_CONVERGED)
    status[1, 1] |= int(Status.BAD_FIT | Status.UNIDENTIFIED_DIATTENUATION_ANGLE)
    fits["retarder_first"] = replace(fits["retarder_first"], status=status)
    found = compare(fits)
    assert found.scene.units == 47
    used = mask.copy()
    used[1, 0] = False
    np.testing.assert_allclose(found.pooled, found.log_evidence[:, used].sum(axis=1))
    np.testing.assert_array_equal(found.pixel_verdict == "", ~used)
    assert np.isnan(found.probabilities[:, ~used]).all()
    assert found.status[1, 0] & Status.NOT_CONVERGED


def test_with_a_window_every_datum_is_pooled_once():
    window = Window(3, 5)
    truth = Parameters(*(np.full((6, 15), x) for x in (0.05, 0.4, 1.2, 0.5, 0.2)))
    data = polinfer.simulate(Model(), truth, STATES, 0.1, rng=3)
    models = {k: replace(m, neighbours=window) for k, m in ORDERINGS.items()}
    fits = fitted(data, models)
    found = compare(fits)
    assert found.scene.units == 6
    centres = found.log_evidence[:, 1::3, 2::5]
    np.testing.assert_allclose(found.pooled, centres.sum(axis=(1, 2)))
    # beside a model without a window, a pixel's evidences are not of the same data, pooled ones are
    mixed = compare({"alone": polinfer.fit(Model(), data), "shared": fits["retarder_first"]})
    assert mixed.verdict == "shared"
    assert np.isnan(mixed.probabilities).all()
    np.testing.assert_allclose(mixed.pooled, [mixed.log_evidence[0].sum(), centres[0].sum()])
    assert any("window" in note for note in mixed.notes)


def test_regions_are_pooled_by_themselves():
    truth = anywhere((4, 30), np.where(np.arange(30) < 15, 0.0, 0.4))
    data = polinfer.simulate(Model(), truth, STATES, 0.03, rng=1)
    labels = np.where(np.arange(30) < 15, 7, 2) * np.ones((4, 1), int)
    labels[0, 0] = -1
    found = select({"retarder": RETARDER, "with D": Model()}, data, regions=labels)
    assert {label: part.verdict for label, part in found.regions.items()} == {7: "retarder", 2: "with D"}
    assert found.verdict == "with D"
    assert found.regions[7].units == 59
    np.testing.assert_allclose(found.regions[2].log_evidence, found.log_evidence[:, labels == 2].sum(axis=1))
    with pytest.raises(ValueError, match="regions must have"):
        compare(fitted(data), regions=labels[:2])
    with pytest.raises(TypeError, match="integer"):
        compare(fitted(data), regions=labels * 1.0)


def test_select_gives_a_model_that_infers_sigma_data_without_one():
    data = measured(diattenuation=0.0, sigma=0.05)
    candidates = {"known": RETARDER, "inferred": replace(RETARDER, noise=InferredNoise(1.0, 0.0025, "pixel"))}
    found = select(candidates, data)
    assert found.verdict == "known"
    wrong = select(candidates, replace(data, sigma=0.02 * np.ones(data.shape)))
    assert wrong.verdict == "inferred"


def draws_like(fit, data, **other):
    """A stand-in for draws: evidences with errors, and one draw repeated."""
    repeated = Parameters(*(np.broadcast_to(x, (2, 50, *x.shape)) for x in fit.parameters))
    parts = {"model": fit.model, "measurement": data, "parameters": repeated, "status": fit.status, "gain": None,
             "tilt": None, "sigma": None, "log_evidence": fit.log_evidence,
             "log_evidence_error": np.full(data.shape, 0.1)}  # fmt: skip
    return SimpleNamespace(**(parts | other))


def test_draws_bring_standard_errors_and_a_second_opinion():
    data = measured()
    draws = {name: draws_like(f, data) for name, f in fitted(data).items()}
    found = compare(draws)
    _, error = found.bayes_factor(*ORDERINGS)
    np.testing.assert_allclose(error, 0.1 * 2**0.5)
    np.testing.assert_allclose(found.scene.error, 0.1 * 64**0.5)
    assert found.scene.bayes_factor(*ORDERINGS)[1] == pytest.approx(0.8 * 2**0.5)
    assert not any("Laplace" in note for note in found.notes)
    # all draws alike: the density of the data at the maximum, from which the model knows nothing of leaving out
    best = [
        np.asarray(d.model.log_likelihood(Parameters(*(x[0, 0] for x in d.parameters)), data)) for d in draws.values()
    ]
    for name, density in zip(draws, best, strict=True):
        np.testing.assert_allclose(found.leave_one_out[name].log_density, density, rtol=1e-9)
    np.testing.assert_allclose(found.second_opinion.log_evidence, np.sum(best, axis=(1, 2)))
    assert "leave-one-out" in found.table()


def test_results_of_other_data_are_refused():
    data = measured()
    fits = fitted(data)
    other = polinfer.fit(Model(), measured(shape=(16,)))
    with pytest.raises(ValueError, match="pixel shapes"):
        compare({"a": fits["retarder_first"], "b": other})
    with pytest.raises(ValueError, match="sigmas"):
        compare({"a": fits["retarder_first"], "b": polinfer.fit(Model(), replace(data, sigma=2 * data.sigma))})
    a, b = (draws_like(f, data) for f in fits.values())
    b.measurement = replace(data, response=data.response * 1.01)
    with pytest.raises(ValueError, match="responses"):
        compare({"a": a, "b": b})
    a.log_evidence = np.full(data.shape, np.nan)
    with pytest.raises(ValueError, match="no log evidence"):
        compare({"a": a, "b": fits["retarder_first"]})
    with pytest.raises(ValueError, match="at least two"):
        compare({"a": a})
    with pytest.raises(TypeError, match="Fit or Draws"):
        compare({"a": fits["retarder_first"], "b": data})
    with pytest.raises(TypeError, match="dict"):
        compare(list(fits.values()))


def test_table_and_picture_say_what_was_found():
    found = compare(fitted(measured()))
    text = found.table()
    assert "verdict: retarder_first" in text
    assert "Laplace" in text
    assert [row["model"] for row in found.rows()] == list(ORDERINGS)
    assert found.rows()[0]["log_evidence"] == pytest.approx(found.pooled[0])
    titles = [axes.get_title() for axes in found.plot().axes]
    assert "probability of polariser_first" in titles
    weak = compare(fitted(measured(diattenuation=0.0)))
    assert weak.verdict == "undecided"
    assert weak.scene.reason in weak.table()


@pytest.mark.slow  # three models to compile
def test_unbalanced_states_and_no_diattenuation_need_the_model_that_the_orderings_have_in_common():
    """Volumes differ between the orderings, and pooled over 972 pixels this passes for evidence; a note says so."""
    skew = np.array([[1, 1, 1], 0.2 * np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    data = polinfer.simulate(Model(PolariserFirst()), anywhere((972,), 0.0), skew, 0.02, rng=1)
    two = compare(fitted(data))
    assert any("no model is without diattenuation" in note for note in two.notes)
    three = compare(fitted(data, ORDERINGS | {"retarder": RETARDER}))
    assert three.verdict == "retarder"
    assert not any("no model is without diattenuation" in note for note in three.notes)


@pytest.mark.parametrize(("diattenuation", "least"), [(0.3, 0.9), (0.0, 0.0)])
def test_power_is_the_share_of_scenes_whose_verdict_is_right(diattenuation, least):
    models = list(ORDERINGS.values())
    truth = anywhere((500,), diattenuation)
    found = power(*models, STATES, 0.05, 64, truth, simulations=60, rng=5)
    assert found.right + found.wrong + found.undecided == pytest.approx(1)
    assert found.right >= least
    assert found.wrong <= 0.1
    assert found.error == pytest.approx(np.sqrt(found.right * (1 - found.right) / 60))
    again = power(*models, STATES, 0.05, 64, truth, simulations=60, rng=5)
    assert again == found
    # against scenes made and compared one by one
    rng = np.random.default_rng(6)
    verdicts = []
    for _ in range(20):
        chosen = rng.integers(500, size=64)
        data = polinfer.simulate(models[0], Parameters(*(x[chosen] for x in truth)), STATES, 0.05, rng=rng)
        verdicts.append(compare(fitted(data)).verdict)
    share = np.mean([v == "retarder_first" for v in verdicts])
    assert abs(share - found.right) <= 4 * np.sqrt(0.25 / 20 + 0.25 / 60)


def test_power_refuses_what_it_cannot_simulate():
    with pytest.raises(ValueError, match="without neighbours"):
        power(Model(neighbours=Window(1, 3)), Model(), STATES, 0.1, 10, anywhere((5,), 0.1))
    with pytest.raises(ValueError, match="pixels must be"):
        power(Model(), Model(), STATES, 0.1, 0, anywhere((5,), 0.1))
