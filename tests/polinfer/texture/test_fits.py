"""The texture of a fit: what counts, what is saved, what the command line says."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import polinfer
from polinfer import ComplexGain, Fit, Model, Parameters, Status, texture
from polinfer.cli.texture import texture_command
from polinfer.texture.plots import plot_texture


def made_up(shape=(12, 14), fixed=None):
    """A fit whose maps are random numbers; nothing is computed."""
    rng = np.random.default_rng(1)
    angles = [rng.vonmises(0.3, 20, shape) for _ in range(5)]
    parameters = Parameters(0.1 * angles[0], angles[1] / 2, angles[2], angles[3] / 2, angles[4])
    std = Parameters(*(np.full(shape, 0.01) for _ in range(5)))
    none = np.zeros(shape)
    gain = rng.normal(size=(*shape, 2)) @ [1, 1j]
    return Fit(Model(gain=ComplexGain(1.0), fixed=fixed or {}), parameters, std, np.zeros((*shape, 5, 5)), none, none,
               none, gain, np.zeros(shape, np.int32), none, none)  # fmt: skip


def test_each_quantity_has_its_distribution_and_noise_is_subtracted():
    fit = made_up()
    found = texture.of_fit(fit, size=5)
    expected = texture.entropy(fit.parameters.retardance_angle, 5, polinfer.AxialVonMises, std=fit.std.retardance_angle)
    np.testing.assert_array_equal(found.retardance_angle.entropy, expected)
    np.testing.assert_array_equal(
        found.diattenuation.entropy,
        texture.entropy(fit.parameters.diattenuation, 5, polinfer.TruncatedNormal, std=fit.std.diattenuation),
    )
    np.testing.assert_array_equal(found.amplitude.expectation, texture.expectation(np.abs(fit.gain), 5, texture.Chi()))
    np.testing.assert_array_equal(found.phase.entropy, texture.entropy(np.angle(fit.gain), 5))
    kept = texture.of_fit(fit, size=5, subtract_noise=False)
    assert np.all(kept.circularity.entropy > found.circularity.entropy)
    assert kept.circularity.noise_entropy is None


def test_pixels_without_an_answer_do_not_count_nor_do_unidentified_parameters():
    fit = made_up()
    status = fit.status.copy()
    status[:, :3] = int(Status.NOT_CONVERGED)
    status[:, 10:] = int(Status.unidentified("circularity"))
    found = texture.of_fit(replace(fit, status=status), size=3, subtract_noise=False)
    assert found.retardance.count[5].tolist() == [0, 0, 3, 6, *[9] * 9, 6]
    assert np.all(found.circularity.count[5, 11:] == 0)
    assert np.all(np.isnan(found.circularity.entropy[:, 11:]))


def test_fixed_parameters_have_no_texture():
    found = texture.of_fit(made_up(fixed={"diattenuation": 0.0}), size=5)
    assert found.diattenuation is None
    assert found.diattenuation_angle is None
    assert list(found.maps) == ["retardance", "retardance_angle", "circularity", "amplitude", "phase"]


def test_a_texture_is_saved_and_drawn(tmp_path):
    found = texture.of_fit(made_up(), size=5)
    again = polinfer.load(polinfer.save(found, tmp_path / "texture.nc"))
    np.testing.assert_array_equal(again.phase.entropy, found.phase.entropy)
    assert again.amplitude.distribution == texture.Chi(1)
    assert again.retardance.size == 5
    titles = [a.get_title() for a in found.plot(9e-6).axes if a.get_title()]
    assert titles[:2] == ["E(diattenuation)", "E(diattenuation angle) (°)"]
    assert "H(phase) (nat)" in titles
    single = found.phase.plot()
    assert [a.get_title() for a in single.axes][:2] == ["expectation (°)", "entropy (nat)"]
    with pytest.raises(ValueError, match="textures is empty"):
        plot_texture({})


def test_minus_infinity_has_the_lowest_colour_and_no_answer_is_hatched():
    image = np.random.default_rng(2).vonmises(0, 5, (10, 10))
    found = texture.describe(image, 3, fewest=4)
    entropy = found.entropy.copy()
    entropy[0, 0], entropy[0, 1] = -np.inf, np.nan
    drawn = replace(found, entropy=entropy).plot().axes[1].images[0]
    assert drawn.get_array().mask.sum() == 1
    assert drawn.get_array()[0, 0] == entropy[np.isfinite(entropy)].min()


def test_the_command_writes_what_the_library_gives(tmp_path):
    fit = made_up()
    polinfer.save(fit, tmp_path / "fit.nc")
    out, picture = tmp_path / "texture.nc", tmp_path / "texture.png"

    def run(*options):
        return CliRunner().invoke(texture_command, [str(x) for x in (tmp_path / "fit.nc", out, *options)])

    result = run("--size", 5, "--picture", picture, "--pixel-size", 9)
    assert result.exit_code == 0, result.output
    assert "retardance: median entropy without noise" in result.output
    assert "phase: median entropy with noise" in result.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    np.testing.assert_array_equal(polinfer.load(out).retardance.entropy, texture.of_fit(fit, 5).retardance.entropy)
    assert "exists" in run().output
    assert "--pixel-size is only for --picture" in run("--overwrite", "--pixel-size", 9).output
    assert run("--overwrite", "--size", 5, "--with-noise").exit_code == 0
    assert not polinfer.load(out).noise_subtracted
