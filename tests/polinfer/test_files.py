"""What is saved comes back the same, and nothing foreign is believed."""

from dataclasses import dataclass, fields, is_dataclass, replace

import h5py
import numpy as np
import pytest

import polinfer
from polinfer import (
    ComplexGain,
    InferredNoise,
    KnownNoise,
    Measurement,
    Model,
    PhaseGain,
    PolariserFirst,
    UniformAngle,
    VonMises,
    Window,
    phantoms,
)
from polinfer.priors import Prior
from tests.polinfer.scenes import BALANCED, GAINS, X, everywhere


def same(a, b):
    assert type(a) is type(b)
    if isinstance(a, tuple) and hasattr(a, "_fields"):
        for x, y in zip(a, b, strict=True):
            same(x, y)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif is_dataclass(a) and not isinstance(a, Model):
        for field in fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b


def measurement(dtype=np.complex128):
    generator = np.random.default_rng(1)
    response = (generator.normal(size=(3, 4, 2, 3)) + 1j * generator.normal(size=(3, 4, 2, 3))).astype(dtype)
    response[0, 0, 0, 0] = np.nan
    mask = np.ones((3, 4), bool)
    mask[1, 1] = False
    return Measurement(np.ones((2, 3), dtype), response, np.array(0.3), generator.uniform(size=(4, 3)), mask, seed=5)


def fitted(model, told=None):
    """The fit of a frame with a broken and a masked pixel, ``told`` as that of another model if there is one.

    What is stored does not depend on which model was fitted, and code is compiled for each.
    """
    data = polinfer.simulate(replace(model, noise=KnownNoise()), everywhere((3, 4), X), BALANCED, 0.05, rng=1)
    response, mask = data.response.copy(), np.ones((3, 4), bool)
    response[0, 0, 0, 0] = np.nan
    mask[1, 1] = False
    sigma = data.sigma if isinstance(model.noise, KnownNoise) else None
    found = polinfer.fit(model, Measurement(BALANCED, response, sigma, mask=mask))
    return found if told is None else replace(found, model=told)


RECORDS = {
    "measurement": measurement,
    "single precision": lambda: measurement(np.complex64),
    "unknown sigma": lambda: Measurement(np.eye(2), np.eye(2)),
    "phantom": lambda: phantoms.lesion((3, 4), rng=1),
    "fit": lambda: fitted(Model(gain=GAINS["complex"]),
                          Model(gain=ComplexGain(2.0), priors={"circularity": VonMises(0.5, 2.0)})),
    "fit, fixed": lambda: fitted(Model(gain=GAINS["complex"], fixed={"diattenuation": 0.0}),
                                 Model(PolariserFirst(), gain=PhaseGain(), fixed={"diattenuation": 0.0},
                                       priors={"retardance": UniformAngle(2 * np.pi)})),
    "fit, unknown noise": lambda: fitted(Model(noise=InferredNoise(2.0, 0.1, "frame"), neighbours=Window(1, 3))),
}  # fmt: skip


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
@pytest.mark.parametrize("name", RECORDS)
def test_round_trip(name, ending, tmp_path):
    record = RECORDS[name]()
    same(polinfer.load(polinfer.save(record, tmp_path / f"record{ending}")), record)


@dataclass(frozen=True)
class Flat(Prior):
    width: float

    def log_density(self, x):
        import jax.numpy as jnp

        return jnp.where(abs(x) <= self.width / 2, -np.log(self.width), -jnp.inf)

    def sample(self, rng, shape):
        return rng.uniform(-self.width / 2, self.width / 2, shape)

    @property
    def support(self):
        return -self.width / 2, self.width / 2


def test_types_of_ones_own_are_loaded_only_when_offered(tmp_path):
    record = fitted(Model(), Model(priors={"diattenuation": Flat(1.0)}))
    path = polinfer.save(record, tmp_path / "fit.nc")
    same(polinfer.load(path, classes=(Flat,)), record)
    with pytest.raises(ValueError, match="holds a Flat, a type that was not offered"):
        polinfer.load(path)


def test_an_existing_file_is_kept_unless_told(tmp_path):
    path = polinfer.save(measurement(), tmp_path / "a.nc")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        polinfer.save(measurement(), path)
    polinfer.save(phantoms.lesion((2, 2), rng=1), path, overwrite=True)
    assert isinstance(polinfer.load(path), phantoms.Phantom)


def test_foreign_damaged_and_missing_files_are_named(tmp_path):
    import xarray

    path = polinfer.save(measurement(), tmp_path / "a.nc")
    content = path.read_bytes()
    for name, changed in (("cut", content[: len(content) // 2]), ("noise", b"\x89HDF\r\n" + b"x" * 500), ("none", b"")):
        (tmp_path / f"{name}.nc").write_bytes(changed)
        with pytest.raises(ValueError, match=f"{name}.nc"):
            polinfer.load(tmp_path / f"{name}.nc")
    xarray.Dataset({"a": ("x", np.ones(3))}).to_netcdf(tmp_path / "foreign.nc", engine="h5netcdf")
    with pytest.raises(ValueError, match="not a file of this package"):
        polinfer.load(tmp_path / "foreign.nc")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        polinfer.load(tmp_path / "missing.nc")
    with pytest.raises(ValueError, match=r"must end in \.nc"):
        polinfer.save(measurement(), tmp_path / "a.txt")


def test_a_tampered_structure_is_an_error_and_runs_nothing(tmp_path):
    import xarray

    path = polinfer.save(measurement(), tmp_path / "a.nc")
    dataset = xarray.load_dataset(path, engine="h5netcdf")
    empty, extra = '{"record": "Measurement", "fields": {}}', '{"record": "Measurement", "fields": {"x": null}}'
    for structure in ('{"record": "Popen", "fields": {}}', extra, empty, "[", "{}"):
        dataset.attrs["polinfer_structure"] = structure
        dataset.to_netcdf(tmp_path / "bad.nc", engine="h5netcdf")
        with pytest.raises(ValueError, match=r"bad\.nc"):
            polinfer.load(tmp_path / "bad.nc")


@pytest.mark.parametrize("kind", ["link", "soft link", "raw", "virtual", "group"])
def test_only_arrays_that_lie_in_the_file_are_read(kind, tmp_path):
    """A file cannot make its reader look into other files: a variable put elsewhere is refused, though HDF5 follows."""
    record = measurement()
    path, other = polinfer.save(record, tmp_path / "a.nc"), polinfer.save(record, tmp_path / "other.nc")
    with h5py.File(path, "r+") as file:
        name = "response.real"
        values = file[name][()]
        del file[name]
        if kind == "link":
            file[name] = h5py.ExternalLink(other.name, name)
        elif kind == "soft link":
            file[name] = h5py.SoftLink("/response.imag")
        elif kind == "raw":
            values.tofile(tmp_path / "raw")
            file.create_dataset(name, values.shape, values.dtype, external=[("raw", 0, values.nbytes)])
        elif kind == "virtual":
            layout = h5py.VirtualLayout(values.shape, values.dtype)
            layout[:] = h5py.VirtualSource(other.name, name, values.shape)
            file.create_virtual_dataset(name, layout)
        else:
            file.create_group(name)
    with pytest.raises(ValueError, match=r"a\.nc.*response.real is no array of this file"):
        polinfer.load(path)


@pytest.mark.parametrize("position", range(0, 100, 7))
def test_a_flipped_byte_gives_the_record_or_a_clear_error(position, tmp_path):
    path = polinfer.save(phantoms.lesion((2, 2), rng=1), tmp_path / "a.nc")
    content = bytearray(path.read_bytes())
    content[position * len(content) // 100] ^= 0xFF
    path.write_bytes(content)
    message = "a.nc"
    try:
        polinfer.load(path)
    except ValueError as error:
        message = str(error)
    assert "a.nc" in message
