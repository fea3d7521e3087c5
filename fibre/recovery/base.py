"""What every recovery method is, the verb that runs one, and what methods that work row by row share.

In: :class:`fibre.CalibrationFields` and a method. Out: :class:`fibre.Inverse`. Called by users and by the ``recover``
command.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
import scipy.spatial
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from fibre.coupling import positions_on_camera, spot_spacing
from fibre.records import Calibration, CalibrationFields, Inverse
from polinfer.checks import one_of_types
from polinfer.cluster import spread
from polinfer.kept import Kept, fingerprint
from polinfer.storage import array

__all__ = ["Cost", "RecoveryMethod", "RowByRow", "recover"]

TIMED = 3  # rounds of the rows that are tried, the quickest counts: other programs interrupt so short a time
PART = 64  # groups of points that are finished, and kept, together


@dataclass(frozen=True)
class Cost:
    """What a recovery is going to take, found by doing a few of its rows.

    rows: of A^-1, two a point. unknowns: mode amplitudes in a row, median over the points tried. equations: captures.
    seconds: of all rows with the threads of this process. bytes: of the rows when they are stored.
    """

    rows: int
    unknowns: int
    equations: int
    seconds: float
    bytes: int

    def __str__(self) -> str:
        return (
            f"{self.rows} rows of {self.unknowns} unknowns from {self.equations} captures: "
            f"about {self.seconds:.2g} s, {self.bytes / 1e6:.3g} MB"
        )


class RecoveryMethod(ABC):
    """A way to find A^-1 from a calibration: a frozen object of settings with one function.

    takes: the record that it wants, fields that are retrieved or the images themselves.
    """

    takes: ClassVar[type] = CalibrationFields

    @abstractmethod
    def solve(self, fields: Any, progress: bool, folder: str | Path | None, client: Any = None) -> Inverse:
        """The inverse transmission matrix."""


def recover(
    calibration_fields: CalibrationFields | Calibration,
    method: RecoveryMethod,
    progress: bool = False,
    folder: str | Path | None = None,
    client: Any = None,
) -> Inverse:
    """The inverse transmission matrix from calibration fields, by ``method`` (for instance ``ForwardInverse()``).

    ``IntensityOnly()`` takes the :class:`fibre.Calibration` itself.

    ``folder``: where finished rows are kept (made if absent), so that the same call goes on where it was interrupted;
    None: nowhere. ``progress``: show a bar. ``client``: a ``dask.distributed.Client`` over whose workers the rows are
    spread (extra ``cluster``), any of which may be lost; None: the threads of this process.

    Raises TypeError for other records and methods, ValueError where a point was lit in fewer than two states, where a
    window holds no usable fibrelet, and for a folder of another call.
    """
    one_of_types("method", method, (RecoveryMethod,), "pass an object such as ForwardInverse().")
    advice = "make them with retrieve_fields(calibration)."
    if method.takes is Calibration:
        advice = f"pass the calibration itself: {type(method).__name__} retrieves no fields."
    one_of_types("calibration_fields", calibration_fields, (method.takes,), advice)
    return method.solve(calibration_fields, progress, folder, client)


@dataclass(frozen=True)
class _Rows:
    """Finished rows of some groups, sparse (2 p, 2 m): zero elsewhere."""

    matrix: Any = array(("output", "mode"), "1/sqrt(photo-electrons/s)")


class RowByRow(RecoveryMethod):
    """A method that finds the rows of a point, or of neighbours that share a window, from the fibrelets in the window.

    Groups do not depend on each other: they run in threads, and finished ones are kept.
    """

    window: float | None

    def width(self, fields: CalibrationFields) -> float:
        """Side of the window, metres: the setting, or, for None, the distance between spots that are lit together."""
        return spot_spacing(fields) if self.window is None else self.window

    @abstractmethod
    def prepared(self, fields: CalibrationFields) -> Any:
        """What all groups need, made once."""

    @abstractmethod
    def rows(self, prepared: Any, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Rows (2 g, c) of g ``points``, h of all then v, in the ``chosen`` c of the 2 m mode amplitudes."""

    @abstractmethod
    def usable(self, prepared: Any) -> np.ndarray:
        """Which mode amplitudes rows may use, bool (2 m,)."""

    @abstractmethod
    def ridge(self, prepared: Any) -> float:
        """For :attr:`fibre.Inverse.ridge`; 0 where there is none."""

    def groups(self, positions: np.ndarray) -> list[np.ndarray]:
        """Points that share a window, from where they are on the camera (p, 2); all p, each once."""
        return [np.array([point]) for point in range(len(positions))]

    def cost(self, fields: CalibrationFields, tried: int = 8) -> Cost:
        """What :func:`recover` will take: ``tried`` groups of points, evenly spread, are done and thrown away."""
        start = time.perf_counter()
        prepared, positions = self.prepared(fields), positions_on_camera(fields)
        groups, usable, width = self.groups(positions), self.usable(prepared), self.width(fields)
        tree = scipy.spatial.cKDTree(fields.fibrelets.centres)
        some = np.unique(np.linspace(0, len(groups) - 1, min(tried, len(groups))).astype(int))
        tasks = [(groups[i], _within(tree, width, positions[groups[i]], groups[i], usable)) for i in some]
        before = time.perf_counter() - start
        self.rows(prepared, *tasks[0])  # what is done but once is not counted
        spent = []
        with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(os.cpu_count()) as pool:
            for _ in range(TIMED):
                start = time.perf_counter()
                done = list(pool.map(lambda pair: self.rows(prepared, *pair), tasks))
                spent.append(time.perf_counter() - start)
        each = min(spent) / len(tasks)
        unknowns = float(np.median([len(chosen) for _, chosen in tasks]))
        # a complex number and its column index
        size = np.mean([values.size / len(points) for (points, _), values in zip(tasks, done, strict=True)]) * 20
        return Cost(2 * len(positions), int(unknowns), len(fields.fields), before + each * len(groups),
                    int(size * len(positions)))  # fmt: skip

    def solve(
        self, fields: CalibrationFields, progress: bool, folder: str | Path | None = None, client: Any = None
    ) -> Inverse:
        """See :meth:`RecoveryMethod.solve`."""
        prepared = self.prepared(fields)
        positions = positions_on_camera(fields)
        groups = self.groups(positions)
        usable, width = self.usable(prepared), self.width(fields)
        tree = scipy.spatial.cKDTree(fields.fibrelets.centres)
        kept = None
        if folder is not None:
            kept = Kept(folder, fingerprint(fields_key(fields), self), (_Rows,), "calibration or method")
        parts = [groups[start : start + PART] for start in range(0, len(groups), PART)]
        names = [f"rows_{PART * number:06d}" for number in range(len(parts))]
        done = {number: kept.read(name) for number, name in enumerate(names)} if kept is not None else {}
        done = {number: found for number, found in done.items() if found is not None}
        missing = [number for number in range(len(parts)) if number not in done]
        tasks = [
            [(points, _within(tree, width, positions[points], points, usable)) for points in parts[number]]
            for number in missing
        ]
        with tqdm(total=len(positions), desc="rows of A^-1", unit="point", disable=not progress) as bar:
            bar.update(sum(len(points) for number in done for points in parts[number]))
            for place, values in self._finished(prepared, tasks, client):
                number = missing[place]
                rows = [(points, chosen, v) for (points, chosen), v in zip(tasks[place], values, strict=True)]
                done[number] = _Rows(_assembled(fields, rows))
                if kept is not None:
                    kept.write(names[number], done[number])
                bar.update(sum(map(len, parts[number])))
        total = sum((done[number].matrix for number in range(1, len(parts))), start=done[0].matrix)
        return Inverse(scipy.sparse.csr_array(total), self.ridge(prepared), fields)

    def _finished(self, prepared: Any, tasks: list[Any], client: Any) -> Iterator[tuple[int, list[np.ndarray]]]:
        """Number of a part and its rows, as they are finished."""
        if client is not None:
            yield from spread(_rows_of_part, (self, prepared), tasks, client)
            return
        # small systems: threads of BLAS would cost more than they bring, and those of other groups bring it
        with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(os.cpu_count()) as pool:
            for number, task in enumerate(tasks):
                yield number, list(pool.map(lambda pair: self.rows(prepared, *pair), task))


def _rows_of_part(common: tuple[RowByRow, Any], task: list[Any]) -> list[np.ndarray]:
    """On a worker."""
    method, prepared = common
    with threadpool_limits(1, user_api="blas"):
        return [method.rows(prepared, points, chosen) for points, chosen in task]


def _within(
    tree: scipy.spatial.cKDTree, width: float, positions: np.ndarray, points: np.ndarray, usable: np.ndarray
) -> np.ndarray:
    """Mode amplitudes in the square around the points, and its middle."""
    middle = (positions.min(0) + positions.max(0)) / 2
    near = np.asarray(sorted(tree.query_ball_point(middle, width / 2, p=np.inf)), int)
    both = np.concatenate([near, near + tree.n])
    both = both[usable[both]]
    if len(both) == 0:
        raise ValueError(f"window {width:g} m holds no usable fibrelet at point {points[0]}; widen it.")
    return both


def fields_key(fields: CalibrationFields) -> tuple[np.ndarray, ...]:
    """The arrays that an inverse depends on."""
    return (
        fields.fields, fields.variance, fields.reference, fields.fibrelets.centres, fields.inputs.toarray(),
        fields.points, fields.registration,
    )  # fmt: skip


def _assembled(
    fields: CalibrationFields, parts: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> scipy.sparse.csr_array:
    count, cores = len(fields.points), len(fields.fibrelets.centres)
    rows, columns, data = [], [], []
    for points, chosen, values in parts:
        rows.append(np.repeat(np.concatenate([points, points + count]), len(chosen)))
        columns.append(np.tile(chosen, 2 * len(points)))
        data.append(values.ravel())
    place = (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.csr_array((np.concatenate(data), place), shape=(2 * count, 2 * cores))
