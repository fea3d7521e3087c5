"""A calibration that has changed is noticed, one that has not is left alone, and a few probes mend it."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
import scipy.stats

from fibre import ForwardInverse, Inverse, Ridge, basis_pursuit_denoise, recover, refresh, staleness, update_matrix
from fibre.coupling import clean_fibrelets
from polinfer import datasets
from tests.fibre.scenes import WAIST, complex_noise
from tests.fibre.test_recovery import error, held_out
from tests.polinfer.test_datasets import fibre_folder

NOISE = 0.01


def probes_of(scene, count, rng, matrix=None, noise=NOISE):
    """Captures of random fields at all points, each with a piston of its own."""
    generator = np.random.default_rng(rng)
    inputs = complex_noise(generator, (128, count)) / 2
    clean = (scene.matrix if matrix is None else matrix) @ inputs * np.exp(2j * np.pi * generator.random(count))
    fields = (clean + noise * complex_noise(generator, clean.shape)).T.reshape(count, 2, -1)
    return replace(
        scene.calibration(NOISE, 1), fields=fields, variance=np.full(fields.shape, noise**2),
        inputs=scipy.sparse.csr_array(inputs), status=None,
    )  # fmt: skip


def changed(scene, heating):
    """The transmission matrix of the warmed bundle."""
    launch = scene.bundle.launch(scene.plan.points, WAIST)
    return scene.bundle.disturbed(heating=heating).columns(scipy.sparse.block_diag([launch, launch])).toarray()


@pytest.fixture(scope="module")
def inverse(standard):
    return recover(standard.calibration(NOISE, 1), ForwardInverse())


@pytest.mark.parametrize("noise", [NOISE, pytest.param(0.07 * NOISE, marks=pytest.mark.slow)])
def test_a_calibration_that_holds_seldom_raises_an_alarm(standard, inverse, noise):
    """With little noise light of points far from a fibrelet would be taken for a change, were it left out."""
    found = [
        staleness(
            replace(inverse, calibration=standard.calibration(noise, k)), probes_of(standard, 2, 100 + k, noise=noise)
        )
        for k in range(40)
    ]
    probabilities = np.array([f.probability for f in found])
    for level in (0.05, 0.3):
        assert np.count_nonzero(probabilities < level) <= scipy.stats.binom.ppf(0.999, 40, level)
    assert np.median([f.change for f in found]) < 0.01


@pytest.mark.parametrize(("heating", "most"), [(0.003, 0.02), (0.01, 1e-6), (0.03, 1e-6)])
def test_a_change_is_noticed_and_measured(standard, inverse, heating, most):
    new = changed(standard, heating)
    found = staleness(inverse, probes_of(standard, 3, 5, new))
    rows = np.tile(clean_fibrelets(inverse.calibration), 2)
    a, b = standard.matrix[rows], new[rows]
    turned = b * np.exp(-1j * np.angle(np.vdot(a, b)))
    true = np.linalg.norm(turned - a) / np.linalg.norm(a)
    assert found.probability < most
    assert found.change == pytest.approx(true, rel=0.3)


def test_pistons_are_found_and_are_no_change(standard, inverse):
    probes = probes_of(standard, 4, 6)
    turns = np.array([0.3, -1.0, 2.0, 0.0])
    turned = replace(probes, fields=probes.fields * np.exp(1j * turns)[:, None, None])
    one, other = staleness(inverse, probes), staleness(inverse, turned)
    np.testing.assert_allclose(np.exp(1j * (other.piston - one.piston)), np.exp(1j * turns), atol=1e-9)
    assert other.probability == pytest.approx(one.probability, rel=1e-6)
    assert other.change == pytest.approx(one.change, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("heating", [0.01, pytest.param(0.03, marks=pytest.mark.slow)])
def test_refreshed_is_better_than_old_and_than_probes_alone(standard, inverse, heating):
    z = held_out(standard)["rough"]
    new = changed(standard, heating)
    probes = probes_of(standard, 40, 7, new)
    refreshed = refresh(inverse, probes)
    alone = recover(probes, Ridge(window=27e-6))

    def off(found):
        # modulo the common phase that probes with free pistons cannot give
        seen = found.matrix @ (new @ z)
        return np.linalg.norm(seen * np.exp(1j * np.angle(np.vdot(seen, z))) - z) / np.linalg.norm(z)

    assert off(refreshed) < 0.8 * off(inverse)
    assert off(refreshed) < 0.8 * off(alone)
    assert isinstance(refreshed, Inverse)


def test_probes_of_a_calibration_that_holds_do_no_harm(standard, inverse):
    z = held_out(standard)["rough"]
    refreshed = refresh(inverse, probes_of(standard, 10, 8))
    assert error(refreshed, standard, z) < 1.02 * error(inverse, standard, z)


def test_probes_of_another_calibration_are_refused(standard, inverse):
    probes = probes_of(standard, 2, 9)
    with pytest.raises(TypeError, match="inverse must be Inverse"):
        staleness(probes, probes)
    with pytest.raises(TypeError, match="probes must be CalibrationFields"):
        staleness(inverse, inverse)
    moved = replace(probes, points=probes.points + 1e-6)
    with pytest.raises(ValueError, match="probes must have the points"):
        refresh(inverse, moved)


@pytest.mark.parametrize(
    ("state", "count"),
    [("5.04", 10), pytest.param("5.12", 20, marks=pytest.mark.slow), pytest.param("5.04", 40, marks=pytest.mark.slow)],
)
def test_a_measured_fibre_that_was_pressed_is_followed(state, count):
    """5.04: small changes all over. 5.12: nothing of the old matrix is left but where it was strong."""
    fibre_folder()
    matrices = [datasets.multimode_fibre(s).jones.transpose(2, 0, 3, 1).reshape(110, 110) for s in ("5.0", state)]
    old, true = matrices
    generator = np.random.default_rng(1)
    x = complex_noise(generator, (110, count))
    noise = 0.02 * np.sqrt((np.abs(true @ x) ** 2).mean())
    y = true @ x + noise * complex_noise(generator, (110, count))
    fresh = basis_pursuit_denoise(x.T, y.T, noise * np.sqrt(count)).x.T
    scaled = old * np.vdot(old, true) / np.vdot(old, old)  # as good as the old one can be made

    def off(found):
        return np.mean(np.linalg.norm(found - true, axis=1) / np.linalg.norm(true, axis=1))

    assert off(update_matrix(old, x, y, noise)) < 0.95 * min(off(fresh), off(scaled))


def test_wrong_matrices_are_named():
    with pytest.raises(ValueError, match="inputs must have shape"):
        update_matrix(np.ones((3, 4)), np.ones((5, 2)), np.ones((3, 2)), 0.1)
    with pytest.raises(ValueError, match="outputs must have shape"):
        update_matrix(np.ones((3, 4)), np.ones((4, 2)), np.ones((4, 2)), 0.1)
    with pytest.raises(ValueError, match="noise must be > 0"):
        update_matrix(np.ones((3, 4)), np.ones((4, 2)), np.ones((3, 2)), 0.0)
