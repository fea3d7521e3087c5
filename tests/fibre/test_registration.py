"""The facets of a bundle are matched core by core, whatever lies between them, and what cannot match is refused."""

import numpy as np
import pytest
from skimage.transform import AffineTransform, estimate_transform

from fibre import Bundle, Registration, load, register_facets, save


def facets(angle, noise=50e-9, missing=0.04, radius=40e-6, seed=1):
    """Distal and proximal centres with errors and dead cores, the true map, and which core each one is."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[1.01 * c, -s, 3e-6], [s, 0.99 * c, -5e-6]])  # proximal to distal
    bundle = Bundle.hexagonal(radius=radius, registration=matrix, rng=seed)
    rng = np.random.default_rng(seed)
    sides, cores = [], []
    for centres in (bundle.distal_centres, bundle.centres):
        core = rng.permutation(np.flatnonzero(rng.random(bundle.cores) > missing))
        sides.append(centres[core] + noise * rng.standard_normal((len(core), 2)))
        cores.append(core)
    return *sides, np.linalg.inv(np.vstack([matrix, [0, 0, 1]]))[:2], cores


@pytest.mark.parametrize(("angle", "turn"), [(0.0, 0.0), (0.2, 0.4), (-0.3, 0.4), (2.9, np.pi), (-1.2, np.pi)])
def test_every_core_is_found_again(angle, turn):
    distal, proximal, truth, (here, there) = facets(angle)
    found = register_facets(distal, proximal, turn)
    np.testing.assert_array_equal(here[found.pairs[:, 0]], there[found.pairs[:, 1]])
    both = len(set(here) & set(there))
    assert len(found.pairs) >= both - 2
    # two independent errors of 50 nm a coordinate, but for the six numbers that were fitted
    expected = np.sqrt(2 * 2) * 50e-9 * np.sqrt(1 - 6 / (2 * len(found.pairs)))
    assert found.rms == pytest.approx(expected, rel=4 / np.sqrt(4 * len(found.pairs)))
    points = np.random.default_rng(0).uniform(-40e-6, 40e-6, (50, 2))
    expected = points @ truth[:, :2].T + truth[:, 2]
    assert np.abs(found(points) - expected).max() < 60e-9
    assert found.margin > 1.5
    # an independent fit of the same pairs
    fit = estimate_transform("affine", 1e6 * distal[found.pairs[:, 0]], 1e6 * proximal[found.pairs[:, 1]])
    assert isinstance(fit, AffineTransform)
    np.testing.assert_allclose(fit(1e6 * points), 1e6 * found(points), atol=5e-3)


def test_a_lattice_without_jitter_cannot_tell_and_says_so():
    centres = Bundle.hexagonal(radius=30e-6, jitter=0.0, rng=0).centres
    noisy = centres + 50e-9 * np.random.default_rng(0).standard_normal(centres.shape)
    assert register_facets(noisy, centres).margin < 1.1  # a sixth of a turn fits as well
    assert register_facets(noisy, centres, 0.1).margin > 1  # a step of a pitch leaves the rim without partners


def test_it_comes_back_from_its_file(tmp_path):
    distal, proximal, _, _ = facets(0.1)
    found = register_facets(distal, proximal, 0.2)
    again = load(save(found, tmp_path / "registration.nc"))
    assert isinstance(again, Registration)
    np.testing.assert_array_equal(again.matrix, found.matrix)
    np.testing.assert_array_equal(again.pairs, found.pairs)
    assert again.margin == found.margin


def test_what_cannot_match_is_refused():
    distal, proximal, _, _ = facets(0.0)
    with pytest.raises(ValueError, match="must be 20 fibrelets or more"):
        register_facets(distal[:10], proximal)
    with pytest.raises(ValueError, match="do not match"):
        register_facets(distal, np.random.default_rng(0).uniform(-40e-6, 40e-6, (300, 2)), 0.2)
    with pytest.raises(ValueError, match="turn must be"):
        register_facets(distal, proximal, 4.0)
    with pytest.raises(ValueError, match="distal must have shape"):
        register_facets(distal[:, 0], proximal)
