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


def loaded_by(*modules):
    """What a new process has loaded after it has imported these."""
    asked = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert set(modules) <= set(done.stdout.split())
    return set(done.stdout.split())


def test_a_device_s_worker_does_not_wait_for_the_compiler():
    assert not {"jax", "matplotlib"} & loaded_by("acquisition.worker", "acquisition.usb.camera")


@pytest.mark.parametrize(
    ("modules", "forbidden"),
    [
        (("polinfer.checks", "polinfer.storage"), ("polinfer.records", "polinfer.model", "polinfer.fitting", "fibre.")),
        (
            ("acquisition.contracts", "acquisition.exposure", "acquisition.merging", "acquisition.plan",
             "acquisition.recording"),
            ("fibre.", "polinfer.records", "polinfer.model"),
        ),
        (("fibre.records", "fibre.fields", "fibre.calibration"), ("acquisition.",)),
        (("polinfer.fitting", "polinfer.sampling", "polinfer.files"), ("fibre.", "acquisition.")),
    ],
)  # fmt: skip
def test_what_stands_below_does_not_load_what_stands_above(modules, forbidden):
    """A name asked for of a whole package hides from the import contracts which module it comes from."""
    assert not [name for name in loaded_by(*modules) if name.startswith(forbidden)]
