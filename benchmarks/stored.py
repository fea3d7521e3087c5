"""Frames larger than memory: a synthetic frame is written block by block, fitted from disk and compared with its truth.

``--full``: 100 megapixels (10,000 x 10,000, three states, 4.8 GB in single precision), else a megapixel. The memory is
the highest of the process that fits, which is one of its own; the floor of time is what the same pixels take in memory.
``size``: pixels along a side.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

import polinfer
from benchmarks import scenes
from benchmarks.results import Results, in_fresh_process
from polinfer import Measurement, Model, Parameters, Stored, fit_stored
from polinfer.degeneracy import nearest

SIGMA, ROWS = 0.02, 100


def truth(side: int, rows: slice) -> Parameters:
    """Smooth maps whose waves are as long as the frame."""
    y, x = np.meshgrid(np.arange(side)[rows] / side, np.arange(side) / side, indexing="ij")
    return Parameters(0.3 + 0.2 * np.sin(6 * y), 0.4 * np.cos(5 * x), 1.2 + 0.8 * np.sin(7 * x + 3 * y),
                      0.5 * np.sin(4 * y - x), 0.3 * np.cos(6 * x * y))  # fmt: skip


def write(path: Path, side: int) -> None:
    """The measurement, some rows at a time."""
    states, rows = scenes.balanced_states().astype(np.complex64), max(1, min(ROWS, side))
    store = None
    for start in range(0, side, rows):
        part = slice(start, min(start + rows, side))
        rng = np.random.default_rng(start)
        jones = Model().jones(truth(side, part)).astype(np.complex64)
        clean = jones @ states
        noise = rng.standard_normal((*clean.shape, 2), np.float32) * np.float32(SIGMA / 2**0.5)
        block = Measurement(states, clean + noise.view(np.complex64)[..., 0], np.float32(SIGMA))
        store = store or Stored.create(path, block, (side, side), (rows, side))
        store.write((part, slice(0, side)), block)


def peak() -> float:
    """Gigabytes that this process has held at most; Linux's getrusage also counts what its parent held before it."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines["VmHWM"].split()[0]) * 1024 / 1e9


def fitted(folder: str) -> list[float]:
    """Seconds, and gigabytes before and at most, of a process that fits ``folder``."""
    before = peak()
    start = time.perf_counter()
    fit_stored(Model(), Path(folder) / "frame.zarr", Path(folder) / "fit.zarr", covariance=False)
    return [time.perf_counter() - start, before, peak()]


def main(size: int | None = None, full: bool = False) -> None:
    """Print the table."""
    results = Results("stored")
    side = size or (10_000 if full else 1000)
    folder = Path(tempfile.mkdtemp())
    try:
        start = time.perf_counter()
        write(folder / "frame.zarr", side)
        wrote = time.perf_counter() - start
        spent, before, most = in_fresh_process(fitted, str(folder), double=False)
        sizes = [sum(f.stat().st_size for f in (folder / name).rglob("*") if f.is_file()) / 1e9
                 for name in ("frame.zarr", "fit.zarr")]  # fmt: skip
        rows = slice(0, min(ROWS, side))
        some = Stored(folder / "frame.zarr").read((rows, slice(0, side)))
        polinfer.fit(Model(), some)
        start = time.perf_counter()
        polinfer.fit(Model(), some)
        in_memory = (time.perf_counter() - start) * side / ROWS
        found = Stored(folder / "fit.zarr")
        errors = []
        for start_row in range(0, side, max(1, side // 10)):
            part = slice(start_row, min(start_row + 10, side))
            fit = found.read((part, slice(0, side)))
            bound = polinfer.cramer_rao_bound(Model(), truth(side, part), scenes.balanced_states(), SIGMA).retardance
            true = nearest(polinfer.orbit(truth(side, part)), fit.parameters).retardance
            off_by = np.angle(np.exp(1j * (np.asarray(fit.parameters.retardance) - np.asarray(true))))
            errors.append(off_by / np.asarray(bound))
        off = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
        results.add(megapixels=side**2 / 1e6, seconds_to_write=wrote, seconds_to_fit=spent, seconds_in_memory=in_memory,
                    gigabytes_measurement=sizes[0], gigabytes_fit=sizes[1], memory_before=before, memory_most=most,
                    rms_over_bound=off)  # fmt: skip
        results.bar("memory of the process that fits", most, 2.0, "GB")
        results.bar("rms error of the retardance over its bound", off, 1.05)
    finally:
        shutil.rmtree(folder)
    results.save()


if __name__ == "__main__":
    main()
