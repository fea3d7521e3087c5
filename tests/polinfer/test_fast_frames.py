"""A frame by the fast route: each pixel is fitted alone, whatever the frame holds and however it is cut."""

from dataclasses import replace

import numpy as np
import pytest

from polinfer import (
    ComplexGain,
    Measurement,
    Model,
    Parameters,
    PhaseGain,
    PolariserFirst,
    Status,
    fit,
    simulate,
)
from polinfer.fitting import frames
from polinfer.fitting.fast import kernel
from tests.polinfer.scenes import (
    BALANCED,
    FREE,
    UNBALANCED,
    case,
    drawn,
    fitted,
    general,
    measured,
)


def frame(shape, seed=1, sigma=0.05):
    rng, count = np.random.default_rng(seed), int(np.prod(shape))
    # code is compiled for every number of pixels: the small frames are cut from one
    data = simulate(FREE, drawn(FREE, max(count, 64), rng), BALANCED, sigma, rng=rng)
    return measured(data.response[:count].reshape(*shape, 2, 3), sigma)


def assert_equal(one, other, where=..., there=..., atol=0.0):
    """Two fits agree in every array, NaN included; ``atol`` in every unit."""
    for group in ("parameters", "std"):
        for name in Parameters._fields:
            ours, theirs = getattr(getattr(one, group), name)[where], getattr(getattr(other, group), name)[there]
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol, err_msg=f"{group}.{name}")
    for name in ("covariance", "log_posterior", "log_evidence", "chi_square", "sigma"):
        ours, theirs = getattr(one, name)[where], getattr(other, name)[there]
        np.testing.assert_allclose(ours, theirs, rtol=atol, atol=atol, err_msg=name)
    np.testing.assert_array_equal(one.status[where], other.status[there])
    np.testing.assert_array_equal(one.degrees_of_freedom[where], other.degrees_of_freedom[there])


def refuse(*args, **more):
    raise AssertionError("the general route was taken")


def test_no_pixel_of_a_clean_frame_of_a_shipped_model_takes_the_general_route(monkeypatch):
    monkeypatch.setattr(frames, "_fit_general", refuse)
    result = fit(FREE, frame((8, 8)))
    assert (result.status & int(Status.NOT_CONVERGED) == 0).all()
    with pytest.raises(AssertionError, match="general route"):
        fit(general(FREE), frame((8, 8)))


@pytest.mark.parametrize("shape", [(), (1,), (1, 1), (1, 7), (2, 1, 3)])
def test_a_pixel_does_not_depend_on_the_frame_that_it_is_in(shape):
    response, some = frame((12,)).response, int(np.prod(shape))
    part = fit(FREE, Measurement(BALANCED, response[:some].reshape(*shape, 2, 3), 0.05))
    whole = fit(FREE, Measurement(BALANCED, response, 0.05))
    assert part.status.shape == part.std.retardance.shape == shape
    assert part.covariance.shape == (*shape, 5, 5)
    assert_equal(part, whole, ..., np.arange(some).reshape(shape), 1e-12)


def test_more_pixels_than_a_block_are_fitted_as_block_by_block():
    data = frame((5000,), sigma=0.2)
    whole = fit(FREE, data)
    for begin in (0, 1000, 3900, 4100):
        part = slice(begin, begin + 900)
        # a few pixels at a time and many are compiled code of their own, which may round otherwise
        assert_equal(fit(FREE, Measurement(BALANCED, data.response[part], 0.2)), whole, np.s_[...], part, 1e-6)


def test_a_gain_in_another_unit_is_fitted_by_the_same_code():
    (model, data), one = case("skew states"), fitted("skew states")
    compiled = kernel.climb_statistics._cache_size()
    scaled = replace(data, response=2e-4 * data.response, sigma=2e-4 * data.sigma)
    other = fit(replace(model, gain=ComplexGain(2e-4 * model.gain.scale)), scaled)
    assert kernel.climb_statistics._cache_size() == compiled
    for name in Parameters._fields:
        np.testing.assert_allclose(getattr(other.parameters, name), getattr(one.parameters, name), atol=1e-6)
    np.testing.assert_allclose(other.gain, 2e-4 * one.gain, atol=1e-9)


def test_both_orderings_and_any_gain_share_the_description_of_a_maximum():
    data = frame((4,))
    fit(Model(gain=ComplexGain(1.0)), data)
    compiled = kernel.described._cache_size()
    fit(Model(ordering=PolariserFirst(), gain=PhaseGain()), data)
    assert kernel.described._cache_size() == compiled


def test_masked_and_nan_pixels_are_nan_and_leave_the_others_alone():
    clean = frame((6, 7))
    response, mask = clean.response.copy(), np.ones((6, 7), bool)
    response[1, 2, 0, 1] = np.nan
    response[4, 4, 1, 0] = np.inf
    mask[0, :3] = False
    response[0, 1] = np.nan
    result, expected = fit(FREE, Measurement(BALANCED, response, clean.sigma, mask=mask)), fit(FREE, clean)
    lost = ~mask
    lost[1, 2] = lost[4, 4] = True
    assert (result.status[~mask] == Status.MASKED).all()
    assert result.status[1, 2] == result.status[4, 4] == Status.NON_FINITE
    for values in (*result.parameters, *result.std, result.covariance, result.log_posterior, result.log_evidence,
                   result.chi_square):  # fmt: skip
        assert np.isnan(values[lost]).all()
    assert_equal(result, expected, ~lost, ~lost, 1e-12)


def test_a_nan_in_a_state_of_weight_0_is_no_loss():
    model, data = case("skew states")
    response, weight = data.response.copy(), np.array([1.0, 0.0, 1.0])
    response[2, 0, 1] = response[3, 1, 1] = np.nan
    response[5, 0, 2] = np.nan
    result = fit(model, Measurement(UNBALANCED, response, data.sigma, weight=weight))
    assert np.flatnonzero(result.status & int(Status.NON_FINITE)).tolist() == [5]
    others = np.delete(np.arange(64), 5)
    expected = fit(model, Measurement(UNBALANCED, data.response, data.sigma, weight=weight))
    assert_equal(result, expected, others, others, 1e-12)


def test_responses_that_overflow_are_never_ok_and_nan():
    data = frame((12,))
    response = data.response.copy()
    response[2:6] *= np.array([1e20, 1e150, 1e200, 1e307])[:, None, None]
    with np.errstate(all="ignore"):
        result = fit(FREE, Measurement(BALANCED, response, data.sigma))
    for values in (*result.parameters, *result.std, result.log_posterior, result.log_evidence, result.chi_square):
        told = result.status & int(Status.NOT_CONVERGED | Status.NON_FINITE | Status.BAD_FIT) != 0
        assert (np.isfinite(values) | told).all()
    assert (result.status[2:6] != 0).all()
    others = np.delete(np.arange(12), range(2, 6))
    assert_equal(result, fit(FREE, data), others, others, 1e-12)


def test_identical_pixels_have_identical_fits():
    one = frame((), seed=7)
    many = fit(FREE, Measurement(BALANCED, np.broadcast_to(one.response, (70, 2, 3)).copy(), one.sigma))
    for values in (*many.parameters, *many.std, many.log_posterior, many.log_evidence, many.status):
        assert (values == values[0]).all()
    assert_equal(many, fit(FREE, one), 0, ..., 1e-12)


def test_an_earlier_fit_never_makes_the_answer_worse():
    data = frame((40,), sigma=0.3)
    cold = fit(FREE, data)
    wrong = fit(FREE, frame((40,), seed=99, sigma=0.3))
    for start in (cold, wrong):
        warm = fit(FREE, data, start=start)
        assert warm.started_from_fit
        assert not cold.started_from_fit
        assert_equal(warm, cold, ..., ..., 1e-6)


def test_single_precision_stays_single_and_agrees_with_double():
    (model, double), high = case("skew states"), fitted("skew states")
    single = Measurement(UNBALANCED.astype(np.complex64), double.response.astype(np.complex64),
                         double.sigma.astype(np.float32))  # fmt: skip
    low = fit(model, single)
    arrays = (*low.parameters, *low.std, low.covariance, low.log_posterior, low.log_evidence, low.chi_square, low.sigma)
    assert all(x.dtype == np.float32 for x in arrays)
    assert low.gain.dtype == np.complex64
    assert (low.status & int(Status.NOT_CONVERGED) == 0).all()
    sure = (high.status == 0) & (low.status == 0)
    assert sure.mean() > 0.5
    seen = [f.gain[:, None, None] * np.asarray(model.jones(f.parameters)) for f in (low, high)]
    assert (np.abs(seen[0] - seen[1]).max(axis=(-1, -2)) / double.sigma)[sure].max() < 0.02
    np.testing.assert_allclose(low.log_posterior, high.log_posterior, atol=2e-3)
    for name in Parameters._fields:
        np.testing.assert_allclose(getattr(low.std, name)[sure], getattr(high.std, name)[sure], rtol=0.03)
    np.testing.assert_allclose(low.log_evidence[sure], high.log_evidence[sure], atol=0.05)
