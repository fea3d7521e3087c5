"""The examples of this package run as they stand."""

import os
import runpy
import sys
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import pytest

import polinfer

from .test_datasets import fibre_folder

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Runs an example as a program of its own would run, in this process, and returns what it printed."""

    def whole(name, optimised=False):
        before = jax.config.jax_enable_x64
        jax.config.update("jax_enable_x64", False)  # as a program begins
        jax.config.update("jax_disable_most_optimizations", not optimised)  # compiling is most of their time
        monkeypatch.setattr(sys, "argv", [name, str(tmp_path)])
        try:
            runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        finally:
            jax.config.update("jax_enable_x64", before)
            plt.close("all")
        return capsys.readouterr().out

    return whole


def test_one_pixel(run, tmp_path):
    assert "Status.OK: 0" in run("01_one_pixel.py")
    assert isinstance(polinfer.load(tmp_path / "one_pixel.nc"), polinfer.Fit)


def test_texture(run, tmp_path):
    assert "noise taken out" in run("04_texture.py")
    assert isinstance(polinfer.load(tmp_path / "texture.nc"), polinfer.texture.FitTexture)


def test_tilted_arms(run, tmp_path):
    assert "tilted" in run("07_tilted_arms.py")
    assert (tmp_path / "tilted_arms.png").stat().st_size > 10_000


def test_measured_fibre(run, tmp_path):
    fibre_folder()
    assert "BAD_FIT" in run("02_measured_fibre.py")
    assert (tmp_path / "measured_fibre.png").stat().st_size > 10_000


def test_phantoms(run, tmp_path):
    assert "stretched gel" in run("05_phantoms.py")
    assert (tmp_path / "speckle.png").stat().st_size > 10_000


def test_contrast(run, tmp_path):
    assert "gCNR" in run("06_contrast.py")
    assert (tmp_path / "contrast.png").stat().st_size > 10_000


def test_microlenses(run, tmp_path):
    folder = fibre_folder()
    if not (folder / "tie_microlens").is_dir() and os.environ.get("POLINFER_REQUIRE_DATA") != "1":
        pytest.skip(f"measured data are not here: {folder} has no tie_microlens")
    said = run("08_microlens.py", optimised=True)  # whose time is that of large frames
    lengths = [float(line.split("f = ")[1].split()[0]) for line in said.splitlines() if line.startswith("lens ")]
    assert len(lengths) == 6
    assert max(lengths) < 1.04 * min(lengths)  # one array, one focal length
    assert (tmp_path / "microlens.png").stat().st_size > 10_000


def test_defocus_stack(run, tmp_path):
    folder = fibre_folder()
    if not (folder / "dhm_defocus_stack").is_dir() and os.environ.get("POLINFER_REQUIRE_DATA") != "1":
        pytest.skip(f"measured data are not here: {folder} has no dhm_defocus_stack")
    said = run("09_defocus_stack.py", optimised=True)
    scores = [float(part.split()[0]) for part in said.strip().splitlines()[-2].split("um:")[1:]]
    # images never used, against what 100 sweeps of Gerchberg-Saxton of an independent program predict
    assert len(scores) == 4
    assert all(score > bar for score, bar in zip(scores, (0.462, 0.690, 0.540, 0.447), strict=True))
    assert (tmp_path / "defocus-stack.png").stat().st_size > 10_000


def test_letters_behind_a_fibre(run, tmp_path):
    said = run("10_logo.py")
    assert "amplitude of the letters 0.50" in said or "amplitude of the letters 0.49" in said
    assert (tmp_path / "logo.png").stat().st_size > 10_000
