"""Save and load records: one netCDF-4 file (``.nc``) or one Zarr folder (``.zarr``), readable without this package.

A record is a frozen dataclass whose array fields are declared with :func:`array`. It is written as a flat set of
labelled variables (``parameters.retardance``), complex numbers as two real ones (``response.real``,
``response.imag``: strict netCDF has no complex type), sparse matrices as their three arrays, and everything else
(models, priors, settings, seeds) as JSON. Nothing is ever unpickled or evaluated: a file names the types that it
needs, and only types that the caller offers are made.

What goes in: a record. What comes out: the same record. Who calls it: ``polinfer.save`` / ``polinfer.load``, and
the same verbs of the packages above, which offer their own record types.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

__all__ = ["array", "from_dataset", "load", "save", "setting", "to_dataset"]

FORMAT = 1
CONVENTION = (
    "SI units; leading axes are pixels (y, x); Jones matrices are the last two axes; component 0 is horizontal; "
    "an axis at angle t points along (cos t, -sin t); J = A_pol A_ret is retarder_first; E|n|^2 = sigma^2 per complex "
    "component"
)
UNITS = {"diattenuation": "1"}  # of Parameters fields; the other four are angles in radians


def array(dims: tuple[str, ...], units: str, **kwargs: Any) -> Any:
    """Declare an array field of a record: the names of its axes and the unit of its values.

    The axis name ``"*P"`` stands for any number of leading pixel axes, named ``y, x`` when there are two.

    >>> import dataclasses, numpy as np
    >>> @dataclasses.dataclass(frozen=True)
    ... class Frame:
    ...     radiance: np.ndarray = array(("y", "x"), "photo-electrons")
    >>> to_dataset(Frame(np.zeros((2, 3)))).radiance.attrs["units"]
    'photo-electrons'
    """
    return dataclasses.field(metadata={"dims": dims, "units": units}, **kwargs)


def setting(**kwargs: Any) -> Any:
    """Declare a field that is stored as JSON: a number, a string, a tuple, or a frozen dataclass of such."""
    return dataclasses.field(**kwargs)


def _axis_names(dims: tuple[str, ...], ndim: int) -> list[str]:
    names: list[str] = []
    for dim in dims:
        if dim == "*P":
            pixels = ndim - (len(dims) - 1)
            names += ["y", "x"] if pixels == 2 else [f"pixel_{i}" for i in range(pixels)]
        else:
            names.append(dim)
    # leading axes may be absent where they broadcast
    return names[len(names) - ndim :] if len(names) >= ndim else [f"axis_{i}" for i in range(ndim)]


class _Writer:
    def __init__(self) -> None:
        self.variables: dict[str, tuple[list[str], np.ndarray, dict[str, str]]] = {}
        self.sizes: dict[str, int] = {}

    def variable(self, path: str, values: np.ndarray, dims: tuple[str, ...], units: str) -> str:
        names = []
        for name, size in zip(_axis_names(dims, values.ndim), values.shape, strict=True):
            if self.sizes.setdefault(name, size) != size or name in names:
                name = f"{path}.{name}"
                self.sizes[name] = size
            names.append(name)
        self.variables[path] = (names, values, {"units": units})
        return path

    def encode(self, path: str, value: Any, dims: tuple[str, ...], units: str) -> Any:
        if value is None:
            return None
        if scipy.sparse.issparse(value):
            csr = scipy.sparse.csr_array(value)
            parts = {
                part: self.encode(f"{path}.{part}", getattr(csr, part), (f"{path}.{part}_entry",), units)
                for part in ("data", "indices", "indptr")
            }
            return {"sparse": parts, "shape": list(csr.shape)}
        if dataclasses.is_dataclass(value) and any("dims" in f.metadata for f in dataclasses.fields(value)):
            fields = {}
            for field in dataclasses.fields(value):
                if field.init:
                    below = field.name if not path else f"{path}.{field.name}"
                    meta = field.metadata
                    fields[field.name] = self.encode(
                        below, getattr(value, field.name), meta.get("dims", ("*P",)), meta.get("units", "1")
                    )
            return {"record": type(value).__name__, "fields": fields}
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            fields = {
                name: self.encode(f"{path}.{name}", getattr(value, name), dims, UNITS.get(name, "rad"))
                for name in value._fields
            }
            return {"record": type(value).__name__, "fields": fields}
        if hasattr(value, "shape") and hasattr(value, "dtype"):
            values = np.asarray(value)
            if values.dtype.kind == "c":
                self.variable(f"{path}.real", values.real, dims, units)
                self.variable(f"{path}.imag", values.imag, dims, units)
                return {"complex": path, "dtype": values.dtype.name}
            return {"array": self.variable(path, values, dims, units), "dtype": values.dtype.name}
        return {"value": _to_json(path, value)}


def _to_json(path: str, value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {"$dict": [[_to_json(path, k), _to_json(path, v)] for k, v in value.items()]}
    if isinstance(value, tuple | list):
        return [_to_json(path, v) for v in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {
            f.name: _to_json(f"{path}.{f.name}", getattr(value, f.name)) for f in dataclasses.fields(value) if f.init
        }
        return {"$type": type(value).__name__, "fields": fields}
    raise TypeError(f"record: its field {path} holds a {type(value).__name__}, which cannot be stored; make it a "
                    "frozen dataclass of numbers, strings, tuples and dicts.")  # fmt: skip


def _written(record: Any) -> tuple[_Writer, dict[str, Any]]:
    """The variables of a record, and the attributes of the file."""
    if not dataclasses.is_dataclass(record) or isinstance(record, type):
        raise TypeError(f"record must be a record of this package, got {type(record).__name__}.")
    writer = _Writer()
    structure = writer.encode("", record, ("*P",), "1")
    if structure is None or "record" not in structure:
        raise TypeError(f"record must be a record with array fields, got {type(record).__name__}.")
    attributes = {
        "polinfer_format": FORMAT,
        "polinfer_record": type(record).__name__,
        "polinfer_structure": json.dumps(structure),
        "convention": CONVENTION,
        "versions": json.dumps({name: metadata.version(name) for name in ("polinfer", "numpy", "scipy", "jax")}),
    }
    return writer, attributes


def to_dataset(record: Any) -> Any:
    """The record as a flat, labelled :class:`xarray.Dataset`, the form in which it is stored."""
    import xarray

    writer, attributes = _written(record)
    return xarray.Dataset(writer.variables, attrs=attributes)


class _Reader:
    def __init__(self, values: Mapping[str, np.ndarray], classes: Iterable[type]) -> None:
        self.values = values
        self.classes = {cls.__name__: cls for cls in classes}

    def make(self, name: str, fields: dict[str, Any]) -> Any:
        if name not in self.classes:
            raise ValueError(
                f"path holds a {name}, a type that was not offered; pass classes=({name},) if it is yours, or use "
                "load of the package that wrote it."
            )
        cls = self.classes[name]
        known = set(getattr(cls, "_fields", ())) or {f.name for f in dataclasses.fields(cls) if f.init}
        if not set(fields) <= known:
            raise ValueError(f"path has unknown fields {sorted(set(fields) - known)} in its {name}; was it written by "
                             "a newer version?")  # fmt: skip
        return cls(**fields)

    def decode(self, node: Any) -> Any:
        if node is None:
            return None
        if "record" in node:
            return self.make(node["record"], {name: self.decode(child) for name, child in node["fields"].items()})
        if "sparse" in node:
            parts = tuple(self.decode(node["sparse"][part]) for part in ("data", "indices", "indptr"))
            matrix = scipy.sparse.csr_array(parts, shape=tuple(node["shape"]))
            matrix.check_format(full_check=True)
            return matrix
        if "complex" in node:
            real, imag = (self.values[f"{node['complex']}.{part}"] for part in ("real", "imag"))
            values = np.empty(real.shape, node["dtype"])
            values.real, values.imag = real, imag
            return values
        if "array" in node:
            return np.asarray(self.values[node["array"]]).astype(node["dtype"], copy=False)
        return self.from_json(node["value"])

    def from_json(self, value: Any) -> Any:
        if isinstance(value, list):
            return tuple(self.from_json(v) for v in value)
        if isinstance(value, dict) and "$dict" in value:
            return {self.from_json(k): self.from_json(v) for k, v in value["$dict"]}
        if isinstance(value, dict):
            return self.make(value["$type"], {k: self.from_json(v) for k, v in value["fields"].items()})
        return value


def from_dataset(dataset: Any, classes: Iterable[type]) -> Any:
    """The record that :func:`to_dataset` made the dataset from; ``classes`` are the types it may be made of."""
    return _record(*_contents(dataset), classes)


# attributes of a file and its variables
_Contents = tuple[Mapping[str, Any], Mapping[str, np.ndarray]]


def _contents(dataset: Any) -> _Contents:
    return dataset.attrs, {name: variable.values for name, variable in dataset.variables.items()}


def _record(attributes: Mapping[str, Any], values: Mapping[str, np.ndarray], classes: Iterable[type]) -> Any:
    if "polinfer_structure" not in attributes:
        raise ValueError("path is not a file of this package (it has no polinfer_structure); open it with xarray.")
    if np.asarray(attributes.get("polinfer_format", -1)).item() != FORMAT:  # netCDF makes a row of one number
        raise ValueError(f"path has format {attributes.get('polinfer_format')}, this version reads {FORMAT}; "
                         "update polinfer.")  # fmt: skip
    try:
        return _Reader(values, classes).decode(json.loads(attributes["polinfer_structure"]))
    except (KeyError, AttributeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"path is damaged: {type(error).__name__} {error}; save the record again.") from error


def _write_netcdf(record: Any, path: Path) -> None:
    """One netCDF-4 file. Truth values are bytes with the attribute by which xarray knows them."""
    import h5netcdf

    writer, attributes = _written(record)
    with h5netcdf.File(path, "w") as file:
        file.attrs.update(attributes)
        file.dimensions = writer.sizes
        for name, (dims, values, attrs) in writer.variables.items():
            truth = values.dtype == bool
            stored = file.create_variable(name, dims, data=values.astype(np.int8) if truth else values)
            stored.attrs.update({**attrs, "dtype": "bool"} if truth else attrs)


def _read_netcdf(path: Path) -> _Contents:
    """A netCDF-4 file is an HDF5 file and read as such: readers of netCDF look at all dimensions again for every
    variable, which takes 10 ms each. Only what lies in the file itself is read."""
    import h5py

    with h5py.File(path, "r") as file:
        values = {}
        for name in file:
            found = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
            if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
                raise ValueError(f"{name} is no array of this file")
            if not found.attrs.get("NAME", b"").startswith(b"This is a netCDF dimension but not"):
                values[name] = np.asarray(found[()])
        return dict(file.attrs), values


def _read_zarr(path: Path) -> _Contents:
    import xarray

    return _contents(xarray.open_zarr(path, consolidated=False, decode_times=False, mask_and_scale=False))


def _kind(path: Path) -> str:
    if path.suffix not in (".nc", ".zarr"):
        raise ValueError(f"path must end in .nc (one file) or .zarr (a folder of chunks), got {path.name!r}.")
    return path.suffix


def save(record: Any, path: str | Path, overwrite: bool = False) -> Path:
    """Write a record to ``path`` (``.nc`` or ``.zarr``); an existing one is kept unless ``overwrite``.

    The file appears under its name only when it is complete.

    Raises
    ------
    FileExistsError: ``path`` exists and ``overwrite`` is False. FileNotFoundError: its folder does not exist.
    ValueError: unknown ending. TypeError: no record.
    """
    path = Path(path)
    kind = _kind(path)
    if path.exists() and not overwrite:
        raise FileExistsError(f"path {path} exists; choose another name or pass overwrite=True.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"path {path} is in a folder that does not exist; make {path.parent} first.")
    part = path.with_name(f".{path.name}.part")
    _remove(part)
    try:
        if kind == ".nc":
            _write_netcdf(record, part)
        else:
            to_dataset(record).to_zarr(part, mode="w", consolidated=False)
    except BaseException:
        _remove(part)
        raise
    if path.is_dir():
        _remove(path)
    os.replace(part, path)
    return path


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def load(path: str | Path, classes: Iterable[type]) -> Any:
    """Read the record at ``path``; ``classes`` are the types it may be made of.

    Raises
    ------
    FileNotFoundError: nothing there. ValueError: a foreign, damaged or newer file, or a type that was not offered.
    """
    path = Path(path)
    kind = _kind(path)
    if not path.exists():
        raise FileNotFoundError(f"path {path} does not exist; check the name.")
    try:
        attributes, values = _read_netcdf(path) if kind == ".nc" else _read_zarr(path)
    except Exception as error:  # whatever a damaged file makes the readers raise becomes one clear error
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"path {path} cannot be read as a {kind} file: {reason}; is it damaged or foreign?") from error
    try:
        return _record(attributes, values, classes)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
