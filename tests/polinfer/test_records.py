"""Records refuse what does not fit, in one line that names the argument, and keep what does."""

import numpy as np
import pytest

from polinfer import Measurement, Model, Parameters, fit, phantoms, simulate

EYE, ONES = np.eye(2), np.ones((3, 4, 2, 2))


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"illumination": np.eye(3), "response": ONES}, ValueError, r"illumination must have shape \(\.\.\., 2, any\)"),
        ({"illumination": np.ones((2, 3)), "response": ONES}, ValueError, "illumination has 3 states and response 2"),
        ({"illumination": np.nan * EYE, "response": ONES}, ValueError, "illumination must be finite"),
        ({"illumination": EYE, "response": np.ones((3, 4, 2, 2, 1))}, ValueError, "response must have shape|states"),
        ({"illumination": np.ones((5, 1, 2, 2)), "response": ONES}, ValueError, "illumination has pixel shape"),
        ({"illumination": EYE, "response": ONES, "sigma": -0.1}, ValueError, "sigma must be > 0, got -0.1"),
        ({"illumination": EYE, "response": ONES, "sigma": 0.0}, ValueError, "sigma must be > 0"),
        ({"illumination": EYE, "response": ONES, "sigma": np.nan}, ValueError, "sigma must be finite"),
        ({"illumination": EYE, "response": ONES, "sigma": 0.1 + 0j}, TypeError, "sigma must be real"),
        ({"illumination": EYE, "response": ONES, "sigma": np.ones(3)}, ValueError, "sigma has pixel shape"),
        ({"illumination": EYE, "response": ONES, "weight": np.ones(3)}, ValueError, "weight must have shape"),
        ({"illumination": EYE, "response": ONES, "weight": [-1.0, 1.0]}, ValueError, "weight must be >= 0"),
        ({"illumination": EYE, "response": ONES, "weight": [np.inf, 1.0]}, ValueError, "weight must be finite"),
        ({"illumination": EYE, "response": ONES, "mask": np.zeros((3, 4), bool)}, ValueError, "mask has no True"),
        ({"illumination": EYE, "response": ONES, "mask": np.ones((3, 4))}, TypeError, "mask must be a bool array"),
        ({"illumination": "light", "response": ONES}, TypeError, "illumination must be an array of numbers"),
        ({"illumination": np.ones((2, 0)), "response": np.ones((2, 0))}, ValueError, "at least one illumination state"),
    ],
)  # fmt: skip
def test_wrong_measurements_are_named_in_one_line(arguments, error, text):
    with pytest.raises(error, match=text) as caught:
        Measurement(**arguments)
    assert "\n" not in str(caught.value)


def test_pixel_shape_is_the_broadcast_of_all_parts():
    m = Measurement(EYE, np.ones((4, 1, 2, 2)), np.ones(5), np.ones((1, 1, 2)), np.ones((4, 1), bool))
    assert (m.shape, m.states) == ((4, 5), 2)


def test_precision_is_kept_and_a_nan_response_is_allowed():
    m = Measurement.from_jones(np.full((2, 2), np.nan, np.complex64), 0.1)
    assert m.response.dtype == m.illumination.dtype == np.complex64


def test_jax_arrays_are_accepted():
    import jax.numpy as jnp

    assert isinstance(Measurement(jnp.eye(2), jnp.ones((3, 2, 2)), 0.1).response, np.ndarray)


def test_simulate_adds_noise_of_the_stated_variance_and_repeats_by_seed():
    p = Parameters(np.zeros(20_000), 0.0, 0.0, 0.0, 0.0)
    data = simulate(Model(), p, EYE, 0.3, rng=1)
    error = data.response - EYE
    assert np.mean(np.abs(error) ** 2) == pytest.approx(0.09, rel=0.02)
    assert np.mean(error.real**2) == pytest.approx(0.045, rel=0.03)
    np.testing.assert_array_equal(simulate(Model(), p, EYE, 0.3, rng=data.seed).response, data.response)
    fresh = simulate(Model(), p, EYE, 0.3)
    np.testing.assert_array_equal(simulate(Model(), p, EYE, 0.3, rng=fresh.seed).response, fresh.response)


@pytest.mark.parametrize("shape", [(1, 1), (18, 18), (5, 40)])
def test_the_lesion_scene_is_what_it_says(shape):
    scene = phantoms.lesion(shape, rng=2)
    p = scene.parameters
    assert p.retardance.shape == scene.gain.shape == scene.labels.shape == shape
    assert set(np.unique(scene.labels)) <= {0, 1}
    assert (np.abs(p.diattenuation) < 0.6).all()
    assert ((p.retardance > 0.3) & (p.retardance < 2.5)).all()
    assert ((np.abs(scene.gain) >= 0.6 - 1e-9) & (np.abs(scene.gain) <= 1 + 1e-9)).all()
    np.testing.assert_array_equal(phantoms.lesion(shape, rng=2).gain, scene.gain)


def test_the_lesion_scene_is_smooth_and_has_both_labels():
    scene = phantoms.lesion((40, 40), rng=2)
    assert 0.05 < scene.labels.mean() < 0.6
    values = scene.parameters.retardance
    assert np.abs(np.diff(values, axis=0)).max() < 0.25 * np.ptp(values)


def test_a_fit_becomes_a_labelled_dataset_with_units():
    data = simulate(Model(), phantoms.lesion((3, 4), rng=1).parameters, EYE, 0.05, rng=1)
    dataset = fit(Model(), data).to_dataset()
    assert dataset["parameters.retardance"].dims == ("y", "x")
    assert dataset["parameters.retardance"].attrs["units"] == "rad"
    assert dataset["std.diattenuation"].attrs["units"] == "1"
    assert dataset["covariance"].dims == ("y", "x", "row", "column")
