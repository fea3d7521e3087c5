"""The three packages as they are imported: every public name is there, and nothing is loaded that was not asked for."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

PACKAGES = ("polinfer", "fibre", "acquisition")


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_is_there_and_is_what_its_module_defines(name):
    package = importlib.import_module(name)
    assert len(package.__all__) == len(set(package.__all__)) > 40
    assert set(package.__all__) <= set(dir(package))
    for public in package.__all__:
        found = getattr(package, public)
        # a module of a function's name would take its place: such names are of packages only
        if hasattr(found, "__file__"):
            assert found.__name__ == f"{name}.{public}"
        elif getattr(found, "__module__", "").startswith(PACKAGES):
            assert getattr(importlib.import_module(found.__module__), public) is found
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = package.no_such_name


def test_a_device_s_worker_does_not_wait_for_the_compiler():
    asked = "import sys, acquisition.worker; from acquisition import Usb3VisionCamera; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert {"acquisition.usb.camera", "numpy"} <= loaded
    assert not {"jax", "fibre.records", "polinfer.model", "matplotlib"} & loaded
