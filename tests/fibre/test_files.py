"""Every record of this package comes back from disk as it was."""

from dataclasses import fields, is_dataclass

import numpy as np
import pytest
import scipy.sparse

import fibre
from fibre import Bundle, Defocus, Fibrelets, ForwardInverse, Images, Recording, load, recover, save
from fibre.files import TYPES
from tests.fibre.test_records import calibration


def same(a, b):
    assert type(a) is type(b)
    if scipy.sparse.issparse(a):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a.toarray(), b.toarray())
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif is_dataclass(a):
        for field in fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b


def images(captures=2):
    generator = np.random.default_rng(captures)
    stack = generator.uniform(1, 2, (captures, 5, 6, 7)).astype(np.float32)
    variance = stack.copy()
    variance[0, 0, 0, 0] = np.inf
    return Images(stack, variance, np.isinf(variance), [-1e-5, 1e-5], [0, 2.0, 4.0], np.arange(captures), 8e-7, 1e-6)


def complex_stack(*shape):
    parts = np.random.default_rng(0).normal(size=(2, *shape))
    return parts[0] + 1j * parts[1]


@pytest.fixture(scope="module")
def records(standard):
    calibrated = standard.calibration(0.01, 0)
    sample = standard.smooth_sample()
    made = [
        Bundle.hexagonal(radius=12e-6, rng=1),
        calibration(images=images(2), references=images(1)),
        Recording(images(3), np.ones((2, 3)), images(3), images(1)),
        Defocus(np.ones((2, 3, 8, 8)), [0, 1e-5, 2e-5], 8e-7, 1e-6, variance=np.full((2, 3, 8, 8), np.inf)),
        Fibrelets(np.arange(6.0).reshape(3, 2), 1.6e-6),
        fibre.Registration(np.eye(2, 3), np.arange(6).reshape(3, 2), np.ones((3, 2)), 2.5),
        fibre.Drift(np.arange(2.0), np.ones(2), np.ones((2, 2)), np.ones((2, 3, 3)), np.ones(2), np.zeros(2)),
        images(),
        fibre.Interference(complex_stack(3, 4), np.full((3, 4), np.inf), np.ones((3, 4))),
        fibre.Retrieved(complex_stack(2, 3, 4).astype(np.complex64), np.ones((2, 3, 4)), np.array([0, 3], np.uint8),
                        np.array([5, 6], np.int32)),
        fibre.Staleness(np.array([0.1, -2.0]), 0.02, 0.3),
        fibre.TransmissionImage(*np.arange(24.0).reshape(4, 2, 3)),
        calibrated,
        recover(calibrated, ForwardInverse()),
        standard.recording(sample, standard.light(), 0.01, 0),
    ]  # fmt: skip
    return {type(record).__name__: record for record in made}


def test_the_list_of_records_is_complete(records):
    assert set(records) == {cls.__name__ for cls in TYPES}


@pytest.mark.parametrize("name", [cls.__name__ for cls in TYPES])
def test_round_trip(records, name, tmp_path):
    same(load(save(records[name], tmp_path / "record.nc")), records[name])


@pytest.mark.parametrize("name", ["Inverse", "Calibration"])
def test_round_trip_as_zarr(records, name, tmp_path):
    same(load(save(records[name], tmp_path / "record.zarr")), records[name])


def test_a_lazy_stack_is_saved_as_what_it_shows(bench, tmp_path):
    found = load(save(bench.recording, tmp_path / "recording.nc"))
    for part in ("images", "blank", "references"):
        lazy, kept = getattr(bench.recording, part), getattr(found, part)
        for name in ("radiance", "variance", "saturated"):
            np.testing.assert_array_equal(getattr(kept, name), np.asarray(getattr(lazy, name)))
    assert found.images.saturated.dtype == bool


def test_records_of_the_package_below_are_loaded_too(tmp_path):
    from polinfer import Measurement

    path = save(Measurement(np.eye(2), np.eye(2), 0.1), tmp_path / "a.nc")
    assert isinstance(load(path), Measurement)


def test_damaged_files_are_named(records, tmp_path):
    path = save(records["Inverse"], tmp_path / "inverse.nc")
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"inverse\.nc"):
        load(path)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        load(tmp_path / "missing.nc")


def test_a_sparse_matrix_with_entries_out_of_range_is_refused(records, tmp_path):
    import xarray

    path = save(records["Bundle"], tmp_path / "bundle.nc")
    dataset = xarray.load_dataset(path, engine="h5netcdf", mask_and_scale=False)
    dataset["coupling.indices"].values[3] = 10_000
    dataset.to_netcdf(tmp_path / "bad.nc", engine="h5netcdf")
    with pytest.raises(ValueError, match=r"bad\.nc"):
        load(tmp_path / "bad.nc")
