"""The examples of this package run as they stand."""

import os
import subprocess
import sys
from pathlib import Path

import polinfer

from .test_datasets import fibre_folder

ROOT = Path(__file__).resolve().parents[2]


def run(name, folder):
    settings = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".jax_cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",  # compiling is most of their time
    }
    command = [sys.executable, "-W", "error", str(ROOT / "examples" / name), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env=settings, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_one_pixel(tmp_path):
    assert "Status.OK: 0" in run("01_one_pixel.py", tmp_path)
    assert isinstance(polinfer.load(tmp_path / "one_pixel.nc"), polinfer.Fit)


def test_texture(tmp_path):
    assert "noise taken out" in run("04_texture.py", tmp_path)
    assert isinstance(polinfer.load(tmp_path / "texture.nc"), polinfer.texture.FitTexture)


def test_tilted_arms(tmp_path):
    assert "tilted" in run("07_tilted_arms.py", tmp_path)
    assert (tmp_path / "tilted_arms.png").stat().st_size > 10_000


def test_measured_fibre(tmp_path):
    fibre_folder()
    assert "BAD_FIT" in run("02_measured_fibre.py", tmp_path)
    assert (tmp_path / "measured_fibre.png").stat().st_size > 10_000


def test_phantoms(tmp_path):
    assert "stretched gel" in run("05_phantoms.py", tmp_path)
    assert (tmp_path / "speckle.png").stat().st_size > 10_000


def test_contrast(tmp_path):
    assert "gCNR" in run("06_contrast.py", tmp_path)
    assert (tmp_path / "contrast.png").stat().st_size > 10_000
