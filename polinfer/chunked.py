"""Records that are larger than memory: written and read block by block, and fitted so.

In: a record of a block of pixels, or a folder of chunks (Zarr). Out: the same, on disk. Called by users with frames of
a hundred megapixels or long series, and by ``polinfer fit --pixels-at-a-time``.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from . import storage
from .checks import integer, one_of_types
from .cluster import spread
from .files import TYPES
from .fitting import fit
from .kept import fingerprint
from .misalignment import TiltPlane
from .model import Model
from .noise import InferredNoise
from .precision import double_precision, is_double
from .records import Fit, Measurement, Status

__all__ = ["Stored", "fit_stored"]

Block = tuple[slice, ...]


class Stored:
    r"""A record in a ``.zarr`` folder, of which blocks of pixels are read and written.

    ``shape``: of its pixels, P. ``chunk``: pixels in one chunk along each axis; blocks that are written at the same
    time by different processes must be made of whole chunks.

    >>> import tempfile, polinfer
    >>> path = Path(tempfile.mkdtemp()) / "frame.zarr"
    >>> first = Measurement(np.eye(2), np.ones((2, 6, 2, 2)), sigma=0.1)
    >>> store = Stored.create(path, first, shape=(4, 6), chunk=(2, 6))
    >>> store.write((slice(0, 2), slice(0, 6)), first)
    >>> store.write((slice(2, 4), slice(0, 6)), first)
    >>> polinfer.load(path).shape, Stored(path).read((slice(1, 3), slice(0, 2))).shape
    ((4, 6), (2, 2))
    """

    def __init__(self, path: str | Path, classes: tuple[type, ...] = ()) -> None:
        import xarray

        self.path, self._classes = Path(path), (*TYPES, *classes)
        if self.path.suffix not in (".zarr", ".part"):
            raise ValueError(f"path must be a .zarr folder, which is read in chunks, got {self.path.name!r}.")
        if not self.path.is_dir():
            raise FileNotFoundError(f"path {path} does not exist; check the name.")
        try:
            # no chunks: read when asked, without dask
            self._dataset = xarray.open_zarr(
                self.path, consolidated=False, decode_times=False, mask_and_scale=False, chunks=None
            )
            self._axes, shape = _pixel_axes(self._dataset)
        except Exception as error:  # whatever a damaged folder makes the reader raise becomes one clear error
            raise ValueError(f"path {path} cannot be read as a record in chunks: {error}") from error
        self.shape: tuple[int, ...] = shape

    @classmethod
    def create(cls, path: str | Path, like: Any, shape: tuple[int, ...], chunk: tuple[int, ...]) -> Stored:
        """An empty store for pixels of ``shape``, for blocks of the kind of ``like``, a record of one block.

        What is not written is NaN, or 0 where numbers are whole. Arrays of ``like`` that have none of the block's pixel
        axes belong to all pixels and are written now.

        FileExistsError where ``path`` exists, ValueError for shapes that do not agree.
        """
        import zarr

        path = Path(path)
        if path.suffix not in (".zarr", ".part"):
            raise ValueError(f"path must be a .zarr folder, which is written in chunks, got {path.name!r}.")
        if path.exists():
            raise FileExistsError(f"path {path} exists; choose another name.")
        dataset = storage.to_dataset(like)
        axes, block = _pixel_axes(dataset)
        if not len(block) == len(shape) == len(chunk):
            raise ValueError(f"shape {shape} and chunk {chunk} must have the {len(block)} axes of the block {block}.")
        whole, part = dict(zip(axes, shape, strict=True)), dict(zip(axes, chunk, strict=True))
        group = zarr.open_group(path, mode="w")
        for name, variable in dataset.variables.items():
            dims = [str(d) for d in variable.dims]
            array = group.create_array(
                str(name),
                shape=tuple(whole.get(d, n) for d, n in zip(dims, variable.shape, strict=True)),
                chunks=tuple(min(part.get(d, n), whole.get(d, n)) for d, n in zip(dims, variable.shape, strict=True)),
                dtype=variable.dtype,
                fill_value=np.nan if variable.dtype.kind == "f" else 0,
                dimension_names=dims,
                attributes=dict(variable.attrs),
            )
            if not set(dims) & set(axes):
                array[...] = variable.values
        group.attrs.update(dataset.attrs)
        return cls(path)

    def read(self, block: Block, **instead: Any) -> Any:
        """The record of a block of pixels, one slice an axis; ``instead``: values for all of a variable by its name."""
        dataset = self._dataset.isel(self._chosen(block))
        for name, value in instead.items():
            dataset = dataset.assign({name: dataset[name].copy(data=np.full(dataset[name].shape, value))})
        return storage.from_dataset(dataset, self._classes)

    def write(self, block: Block, record: Any, without: tuple[str, ...] = ()) -> None:
        """Write the record of a block, but for the variables whose names begin with one of ``without``."""
        import zarr

        dataset = storage.to_dataset(record)
        axes, shape = _pixel_axes(dataset)
        chosen = self._chosen(block)
        wanted = tuple(len(range(*s.indices(n))) for s, n in zip(block, self.shape, strict=True))
        if shape != wanted:
            raise ValueError(f"record has pixels {shape}, the block {wanted}.")
        group = zarr.open_group(self.path, mode="r+")
        for name, variable in dataset.variables.items():
            if set(map(str, variable.dims)) & set(axes) and not str(name).startswith(without or ("\0",)):
                place = tuple(chosen.get(str(d), slice(None)) for d in variable.dims)
                array: Any = group[str(name)]
                array[place] = variable.values

    def _chosen(self, block: Block) -> dict[str, slice]:
        if len(block) != len(self.shape):
            raise ValueError(f"block must have a slice for each of the {len(self.shape)} axes, got {len(block)}.")
        return dict(zip(self._axes, block, strict=True))


def _pixel_axes(dataset: Any) -> tuple[list[str], tuple[int, ...]]:
    """Names and sizes of the pixel axes: those of the variable that has most of them."""
    best: list[str] = []
    for variable in dataset.variables.values():
        axes = [str(d) for d in variable.dims if d in ("y", "x") or str(d).startswith("pixel_")]
        best = axes if len(axes) > len(best) else best
    if not best:
        raise ValueError("the record has no pixel axes.")
    return best, tuple(int(dataset.sizes[name]) for name in best)


def _blocks(shape: tuple[int, ...], pixels: int) -> tuple[tuple[int, ...], list[Block]]:
    """Size of a block of at most ``pixels`` (but one row at least), and all of them: whole last axes first."""
    size, left = [1] * len(shape), pixels
    for axis in reversed(range(len(shape))):
        size[axis] = shape[axis] if axis == len(shape) - 1 else max(1, min(shape[axis], left))
        left //= size[axis]
    starts = [range(0, n, s) for n, s in zip(shape, size, strict=True)]
    return tuple(size), [
        tuple(slice(b, min(b + s, n)) for b, s, n in zip(at, size, shape, strict=True))
        for at in itertools.product(*starts)
    ]


def fit_stored(
    model: Model,
    source: str | Path,
    target: str | Path,
    pixels: int = 1 << 20,
    covariance: bool = True,
    progress: bool = False,
    client: Any = None,
    classes: tuple[type, ...] = (),
) -> Path:
    """Fit a measurement on disk, block by block: frames and time series that are larger than memory.

    As :func:`polinfer.fit` of all pixels at once, to rounding. ``target`` appears under its name when all blocks are
    there; until then finished blocks are kept beside it (``.name.part``), and the same call goes on where it was
    interrupted.

    Parameters
    ----------
    model: what every pixel obeys; windows read the rows and columns around their block. source: a :class:`Measurement`
    as ``.zarr``, of pixel shape (..., y, x), best in chunks of whole rows. target: of the :class:`Fit`, ``.zarr``.
    pixels: in a block; a process holds some 600 bytes for each. covariance: False leaves it NaN, which saves 100 of the
    180 bytes that a pixel takes on disk. progress: show a bar. client: a ``dask.distributed.Client`` (extra
    ``cluster``) whose workers fit blocks; they must see both paths, and may be lost. classes: types of your own in the
    source.

    Raises
    ------
    ValueError: a model that needs all pixels of a frame at once (a tilt plane, one sigma a frame); a target that is
    being made by another call; paths that are not ``.zarr``. FileExistsError: the target is there.

    >>> import tempfile, polinfer
    >>> folder, truth = Path(tempfile.mkdtemp()), polinfer.Parameters(*np.full((5, 8, 6), 0.4))
    >>> data = polinfer.simulate(Model(), truth, np.eye(2), sigma=0.01, rng=1)
    >>> path = fit_stored(Model(), polinfer.save(data, folder / "data.zarr"), folder / "fit.zarr", pixels=18)
    >>> together = polinfer.fit(Model(), data)
    >>> bool(np.allclose(polinfer.load(path).parameters.retardance, together.parameters.retardance))
    True
    """
    from tqdm import tqdm

    one_of_types("model", model, (Model,), "pass Model(...).")
    if isinstance(model.misalignment, TiltPlane):
        raise ValueError(
            "model has a TiltPlane, which all pixels of a frame tell together; fit frames that fit memory."
        )
    if isinstance(model.noise, InferredNoise) and not model.noise.integrated:
        raise ValueError('model infers one sigma a frame from all its pixels; take the scope "pixel" or give sigma.')
    pixels = integer("pixels", pixels, low=1)
    source, target = Path(source), Path(target)
    data = Stored(source, classes)
    if target.suffix != ".zarr":
        raise ValueError(f"target must be a .zarr folder, which is written in chunks, got {target.name!r}.")
    if target.exists():
        raise FileExistsError(f"target {target} exists; choose another name or remove it.")
    size, blocks = _blocks(data.shape, pixels)
    part = target.with_name(f".{target.name}.part")
    attributes = {str(k): str(v) for k, v in data._dataset.attrs.items()}
    call = fingerprint(model, str(source.resolve()), attributes, data.shape, size, covariance)
    done = _begun(part, call)
    common = _Call(model, source, part, covariance, classes)
    with tqdm(total=len(blocks), desc="blocks of pixels", unit="block", disable=not progress) as bar:
        if not part.exists():
            _keep(part, call, done)
            _started(common, data, blocks, size)
        left = [number for number in range(len(blocks)) if number not in done]
        bar.update(len(blocks) - len(left))
        tasks = [blocks[number] for number in left]
        finished = spread(_fitted, common, tasks, client) if client is not None else _in_turn(common, tasks)
        for place, _ in finished:
            done.add(left[place])
            _keep(part, call, done)
            bar.update()
    os.replace(part, target)
    _progress(part).unlink()
    return target


class _Call:
    """What every block needs. Sent to workers."""

    def __init__(self, model: Model, source: Path, part: Path, covariance: bool, classes: tuple[type, ...]) -> None:
        self.model, self.source, self.part = model, source.resolve(), part.resolve()
        self.covariance, self.classes, self.double = covariance, classes, is_double()


def _in_turn(common: _Call, tasks: list[Block]) -> Iterator[tuple[int, None]]:
    for number, block in enumerate(tasks):
        _fitted(common, block)
        yield number, None


def _started(common: _Call, data: Stored, blocks: list[Block], size: tuple[int, ...]) -> None:
    """The empty target, from the fit of one pixel that is not masked."""
    for block in blocks:
        measurement = _unless_masked(data, block)
        if measurement is None:
            continue
        at = np.zeros(len(block), int)
        if measurement.mask is not None:
            at = np.argwhere(np.broadcast_to(measurement.mask, measurement.shape))[0]
        pixel = tuple(slice(b.start + int(i), b.start + int(i) + 1) for b, i in zip(block, at, strict=True))
        building = common.part.with_name(common.part.name.replace(".part", ".new.part"))
        if building.exists():
            shutil.rmtree(building)
        Stored.create(building, fit(common.model, data.read(pixel)), data.shape, size)
        os.replace(building, common.part)
        return
    raise ValueError("source: its mask has no True; there is no pixel to use.")


def _unless_masked(data: Stored, block: Block) -> Measurement | None:
    """The measurement of a block; None where all of it is masked."""
    try:
        measurement = data.read(block)
    except ValueError as error:
        if "mask has no True" in str(error):
            return None
        raise
    if not isinstance(measurement, Measurement):
        raise ValueError(f"source holds a {type(measurement).__name__}, not a Measurement.")
    return measurement


def _fitted(common: _Call, block: Block) -> None:
    """Fit one block, with what its windows need around it, in the precision of the caller, and write it."""
    with double_precision(common.double):
        _fitted_so(common, block)


def _fitted_so(common: _Call, block: Block) -> None:
    data, target = Stored(common.source, common.classes), Stored(common.part)
    window = common.model.neighbours
    reach = [0] * len(block)
    if window is not None:
        reach[-2:] = [window.rows // 2, window.columns // 2]
    around = tuple(slice(max(b.start - r, 0), min(b.stop + r, n))
                   for b, r, n in zip(block, reach, data.shape, strict=True))  # fmt: skip
    measurement = _unless_masked(data, around)
    if measurement is None:
        # nothing of it can be used: as if there were no data
        dark = data.read(around, mask=True)
        found = fit(common.model, replace(dark, response=np.full_like(dark.response, np.nan)))
        found = replace(found, status=np.full_like(found.status, int(Status.MASKED)))
    else:
        found = fit(common.model, measurement)
    inner = tuple(slice(b.start - a.start, b.stop - a.start) for b, a in zip(block, around, strict=True))
    target.write(block, _cut(found, inner), () if common.covariance else ("covariance",))


def _cut(found: Fit, inner: Block) -> Fit:
    """Some of the pixels of a fit."""
    if all(s == slice(0, n) for s, n in zip(inner, found.status.shape, strict=True)):
        return found
    changes: dict[str, Any] = {}
    for field in fields(Fit):
        value = getattr(found, field.name)
        if isinstance(value, np.ndarray):
            changes[field.name] = value[inner]
        elif field.name in ("parameters", "std"):
            changes[field.name] = type(value)(*(x[inner] for x in value))
    return replace(found, **changes)


def _begun(part: Path, call: str) -> set[int]:
    """Numbers of the blocks that an earlier call has finished."""
    if not part.exists():
        return set()
    try:
        known = json.loads(_progress(part).read_text())
        if known["call"] == call:
            return {int(number) for number in known["done"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"target: {part} is damaged ({error}); remove it to start anew.") from error
    raise ValueError(f"target: {part} belongs to another model, source or size of block; remove it to start anew.")


def _progress(part: Path) -> Path:
    """Which blocks are finished, in a file beside the folder."""
    return part.with_suffix(".json")


def _keep(part: Path, call: str, done: set[int]) -> None:
    file = _progress(part)
    new = file.with_suffix(".new")
    new.write_text(json.dumps({"call": call, "done": sorted(done)}))
    os.replace(new, file)
