"""Recovery of the inverse transmission matrix at the paper's size: error against time; and solvers of basis pursuit.

A bundle of some 6200 coupled cores, 972 points on 27 x 36, 12 spots at a time 68.2 um apart, three states: 243
captures, with complex noise of 2 % of the mean field. Held out, without noise: (i) random fields at the points; (ii)
smooth fields at the points and, 15 % as strong, light outside of their span. Beside the methods stand what least
squares without any prior on the columns reaches (the plain forward route), and an inverse of the true columns.

Basis pursuit: rows of a measured multimode fibre's matrix (Matthes et al. 2021) from 40, 60 and 80 random inputs with
2 % noise, against the package spgl1 (row by row, as it must be), as it is called and with the data brought to unit
size for it.

``--full``: the paper's window too, the same calibration as images that are retrieved first, and 1000 random problems
for the certificate.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
import scipy.spatial
from matplotlib.figure import Figure

from acquisition import Bracket, CalibrationPlan, CameraModel, SimulatedBench, Views
from acquisition import Scene as BenchScene
from benchmarks import live
from benchmarks.results import Results
from fibre import (
    BasisPursuit,
    Bundle,
    CalibrationFields,
    Fibrelets,
    ForwardInverse,
    Modal,
    Ridge,
    WeightedSum,
    basis_pursuit_denoise,
    recover,
    refresh,
    retrieve_fields,
    staleness,
    update_matrix,
)
from fibre.coupling import coupling_profile
from polinfer import datasets, phantoms

WAIST, NOISE, OUTSIDE = 2.5e-6, 0.02, 0.15
CAMERA_PIXEL = 0.39e-6
VIEWS = Views(tuple(np.linspace(-25e-6, 25e-6, 7).tolist()), bracket=Bracket(64e-3, 4.0, 1e-3))
FEW = 22  # rows that spgl1 is asked for


def noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Complex, E|n|^2 = 1."""
    return np.asarray((rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2))


def gauge_free_error(found: np.ndarray, true: np.ndarray) -> float:
    """Relative, of fields (2 p, k), up to one amplitude and one phase a point, which a blank recording takes out."""
    a, b = (x.reshape(2, -1, x.shape[1]) for x in (found, true))
    a = a * np.exp(1j * np.angle((a.conj() * b).sum((0, 2), keepdims=True)))
    a = a * (np.vdot(a, b).real / np.vdot(a, a).real)
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


class Scene:
    """The bundle, its true columns, the calibration's fields, and held-out pairs of distal and proximal fields."""

    def __init__(
        self,
        grid: tuple[int, int],
        stride: int = 9,
        pitch: float = 68.2e-6 / 9,
        seed: int = 0,
        level: float | None = None,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.plan = plan = CalibrationPlan(grid, pitch=pitch, stride=stride, states=3)
        radius = float(np.hypot(*plan.points.T).max()) + 20e-6
        self.bundle = Bundle.hexagonal(radius=radius, rng=seed)
        self.points = plan.points
        self.matrix = self._through(self.bundle.launch(plan.points, WAIST))
        clean = (self.matrix @ plan.inputs).toarray().T.reshape(-1, 2, self.bundle.cores)
        if level is None:
            level = NOISE * float(np.sqrt((np.abs(clean) ** 2).mean()))
        self.clean = clean
        spot = self.bundle.launch(np.array([[0.0, radius - 5e-6]]), WAIST).toarray()[:, 0]
        self.fields = CalibrationFields(
            clean + level * noise(rng, *clean.shape), np.full(clean.shape, level**2),
            self.bundle.transmit(np.stack([spot, spot]) / np.sqrt(2)), 1.0, 0.0,
            Fibrelets(self.bundle.centres, self.bundle.mode_radius), plan.inputs, plan.points, plan.grid, np.eye(2, 3),
        )  # fmt: skip
        self.level = level
        self.held_out = {"(i)": self._inside(rng), "(ii)": self._smooth(rng, pitch)}

    def _through(self, launch: Any) -> scipy.sparse.csr_array:
        both = scipy.sparse.block_diag([launch, launch], format="csc")
        return scipy.sparse.csr_array(self.bundle.columns(both, faint=1e-7))

    def _inside(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        z = noise(rng, 2 * len(self.points), 20)
        return z, self.matrix @ z

    def _smooth(self, rng: np.random.Generator, pitch: float) -> tuple[np.ndarray, np.ndarray]:
        """A dozen plane waves at the points; and of the same at places between them what no field at the points makes.

        Least squares over the true columns then gives the field at the points back.
        """
        waves = rng.uniform(-1, 1, (2, 12, 2)) * 2 * np.pi / 60e-6
        weights = noise(rng, 2, 12, 10)
        between = self.points + pitch / 2
        at, away = (
            np.concatenate([np.exp(1j * places @ waves[p].T) @ weights[p] for p in range(2)])
            for places in (self.points, between)
        )
        known = self.matrix
        other = self._through(self.bundle.launch(between, WAIST)) @ away
        normal = scipy.sparse.linalg.splu(scipy.sparse.csc_array(known.conj().T @ known))
        other -= known @ normal.solve(known.conj().T @ other)
        seen = known @ at
        return at, seen + OUTSIDE * other * np.linalg.norm(seen) / np.linalg.norm(other)

    def errors(self, inverse: Any) -> list[float]:
        """Relative, of both kinds."""
        pairs = self.held_out.values()
        return [float(np.linalg.norm(inverse @ y - z) / np.linalg.norm(z)) for z, y in pairs]


def plain(scene: Scene) -> scipy.sparse.csr_array:
    """Columns by windowed least squares without a prior, then the inverse with the noise's ridge."""
    fields, count = scene.fields, len(scene.points)
    inputs = fields.inputs.toarray()
    near = scipy.spatial.cKDTree(scene.points).query_ball_point(
        scene.bundle.centres, coupling_profile(fields).reach(1e-5)
    )
    columns = scipy.sparse.lil_array((2 * scene.bundle.cores, 2 * count), dtype=complex)
    spread = np.zeros(2 * scene.bundle.cores)
    for core, points in enumerate(near):
        if points:
            chosen = np.concatenate([points, np.array(points) + count]).astype(int)
            pseudo = np.linalg.pinv(inputs[chosen])
            for p in range(2):
                row = p * scene.bundle.cores + core
                columns[row, chosen] = fields.fields[:, p, core] @ pseudo
                spread[row] = scene.level**2 * np.linalg.norm(pseudo) ** 2
    return inverted(scene, scipy.sparse.csr_array(columns), spread)


def inverted(scene: Scene, columns: scipy.sparse.csr_array, spread: np.ndarray) -> scipy.sparse.csr_array:
    """A^H (A A^H + diag spread)^-1 in windows of 27 um, point by point."""
    count, tree = len(scene.points), scipy.spatial.cKDTree(scene.bundle.centres)
    used = np.diff(columns.indptr) > 0
    rows = scipy.sparse.lil_array((2 * count, 2 * scene.bundle.cores), dtype=complex)
    for point, near in enumerate(tree.query_ball_point(scene.points, 13.5e-6, p=np.inf)):
        both = np.concatenate([near, np.array(near) + scene.bundle.cores]).astype(int)
        both = both[used[both]]
        block = columns[both]
        gram = (block @ block.conj().T).toarray() + np.diag(spread[both])
        solved = scipy.linalg.solve(gram, block[:, [point, point + count]].toarray(), assume_a="pos")
        rows[[point], both], rows[[point + count], both] = solved.conj().T
    return scipy.sparse.csr_array(rows)


def methods(results: Results, size: int | None, full: bool) -> None:
    """The table of recovery methods."""
    scene = Scene((27, 36) if size is None else (size, size))
    known = scene.matrix
    # the noise that a method meets which knows the columns: that of three captures a point
    spread = np.full(known.shape[0], 1e-4 * scene.level**2)
    references: dict[str, Callable[[], Any]] = {
        "least squares, then inverse": lambda: plain(scene),
        "true columns": lambda: inverted(scene, known, spread),
    }
    ours: dict[str, Any] = {
        "ForwardInverse": ForwardInverse(),
        "Ridge": Ridge(),
        "Ridge, 40 um": Ridge(window=40e-6),
        "WeightedSum": WeightedSum(),
        "BasisPursuit, 30 um": BasisPursuit(window=30e-6),
    }
    if full:
        ours["BasisPursuit, 68.2 um"] = BasisPursuit()
    found = {}
    calls = references | {name: (lambda m=m: recover(scene.fields, m).matrix) for name, m in ours.items()}
    for name, call in calls.items():
        start = time.perf_counter()
        matrix = call()
        spent = time.perf_counter() - start
        found[name] = (spent, *scene.errors(matrix))
        results.add(method=name, cores=scene.bundle.cores, rows=matrix.shape[0], seconds=spent,
                    error_i=found[name][1], error_ii=found[name][2])  # fmt: skip
    best, reference = found["ForwardInverse"], found["least squares, then inverse"]
    results.bar("ForwardInverse, all rows", best[0], 5, "s")
    for kind, ours_error, plain_error in zip(["i", "ii"], best[1:], reference[1:], strict=True):
        results.bar(f"({kind}) error over the plain forward route's", ours_error / plain_error, 1.0)
        others = min(value[1 if kind == "i" else 2] for name, value in found.items() if "Basis" in name)
        results.bar(f"({kind}) error over basis pursuit's best", ours_error / others, 1.0)
    results.bar("highest memory so far", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2.0, "GB")


def retrieved(results: Results, size: int | None) -> None:
    """The same calibration as images of a bench that errs, retrieved: how much worse than fields with 2 % of noise?

    Focus 0.3 % and phase steps 5 mrad off, 8 bits, a thousand pixels a side; held-out fields are the true ones.
    """
    grid = (27, 36) if size is None else (size, size)
    scene = Scene(grid)
    bundle, plan = scene.bundle, scene.plan
    radius = float(np.hypot(*bundle.centres.T).max())
    side = 2 * int(np.ceil((radius + 10e-6) / CAMERA_PIXEL))
    bench = SimulatedBench(
        BenchScene(bundle, phantoms.lesion(grid, rng=0), CameraModel((side, side), CAMERA_PIXEL), plan.pitch,
                   reference=(0.0, radius - 5e-6), focus_error=3e-3, step_error=5e-3),
        rng=0,
    )  # fmt: skip
    calibration = live.calibration(bench, replace(plan, views=VIEWS))
    start = time.perf_counter()
    fields = retrieve_fields(calibration, Modal(scene.fields.fibrelets), scene.fields.fibrelets, progress=True)
    middle = time.perf_counter()
    inverse = recover(fields, ForwardInverse()).matrix
    end = time.perf_counter()
    errors = [gauge_free_error(inverse @ y, z) for z, y in scene.held_out.values()]
    results.add(camera=side, captures=len(scene.clean), closure_found=fields.relative_error,
                seconds_simulated_and_retrieved=middle - start,
                seconds_rows=end - middle, error_i=errors[0], error_ii=errors[1])  # fmt: skip
    results.bar("rows from retrieved fields", end - middle, 5, "s")
    for kind, error, reference in zip(("i", "ii"), errors, scene.errors(plain(scene)), strict=True):
        results.bar(
            f"({kind}) from retrieved fields, over the forward route's from 2 % of noise", error / reference, 1.0
        )


def solvers(results: Results) -> None:
    """Rows of the measured matrix."""
    import spgl1

    blocks = datasets.multimode_fibre().jones
    matrix = blocks.transpose(2, 0, 3, 1).reshape(110, 110)
    rng = np.random.default_rng(0)
    for inputs in (40, 60, 80):
        x = noise(rng, 110, inputs)
        clean = matrix @ x
        level = NOISE * np.sqrt((np.abs(clean) ** 2).mean())
        level_rows = np.full(110, level * np.sqrt(inputs))
        a, b = x.T, (clean + level * noise(rng, *clean.shape)).T
        unit = np.linalg.norm(a, 2)

        def error(x: np.ndarray) -> float:
            rows = matrix[: x.shape[1]]
            return float((np.linalg.norm(x.T - rows, axis=1) / np.linalg.norm(rows, axis=1)).mean())

        def published(
            by: float, sizes: np.ndarray, a: np.ndarray = a, b: np.ndarray = b, delta: np.ndarray = level_rows
        ) -> np.ndarray:
            found = []
            for column, limit, size in zip(b.T, delta, sizes, strict=False):
                one, *_ = spgl1.spg_bpdn(a / by, column / size, limit / size, iter_lim=1000, verbosity=0)
                found.append(one * size / by)
            return np.stack(found, axis=1)

        calls: dict[str, Callable[[], np.ndarray]] = {
            "basis_pursuit_denoise": lambda a=a, b=b, d=level_rows: basis_pursuit_denoise(a, b, d).x,
            "spgl1": lambda f=published: f(1.0, np.ones(FEW)),
            "spgl1, unit size": lambda f=published, b=b, u=unit: f(u, np.linalg.norm(b, axis=0)[:FEW]),
        }
        spent, errors = {}, {}
        for name, call in calls.items():
            start = time.perf_counter()
            found = call()
            count = found.shape[1]
            spent[name] = (time.perf_counter() - start) / count
            residual = float((np.linalg.norm(a @ found - b[:, :count], axis=0) / level_rows[:count]).max())
            errors[name] = error(found[:, :FEW])
            results.add(inputs=inputs, solver=name, rows=count, milliseconds_a_row=1e3 * spent[name],
                        mean_error=errors[name], residual_over_delta=residual)  # fmt: skip
        ours = "basis_pursuit_denoise"
        best = min(errors["spgl1"], errors["spgl1, unit size"])
        results.bar(f"{inputs} inputs: error over spgl1's best", errors[ours] / best, 1.0)
        results.bar(f"{inputs} inputs: speed over spgl1's", spent["spgl1"] / spent[ours], 20, at_least=True)


def certificates(results: Results, count: int) -> None:
    """Random problems of all kinds and scales: is the stated residual true, and when does the status say not?"""
    rng = np.random.default_rng(1)
    wrong, flagged = 0, 0
    for k in range(count):
        m, n = int(rng.integers(5, 60)), int(rng.integers(5, 150))
        a = noise(rng, m, n)
        if k % 4 == 1:  # ten neighbouring columns see one fibrelet
            a = np.repeat(noise(rng, m, -(-n // 10)), 10, axis=1)[:, :n] + 10 ** -rng.uniform(0, 4) * a
        if k % 4 == 2:
            a = a * 10 ** rng.uniform(-3, 3, n)
        if k % 4 == 3:
            a = a * np.exp(-np.arange(n) / rng.uniform(3, 50))
        a = a * 10.0 ** rng.uniform(-9, 9)
        x = noise(rng, n, 2) * (rng.random((n, 2)) < min(m, n) / 4 / n)
        b = a @ x
        level = 10 ** rng.uniform(-4, -0.3) * np.linalg.norm(b, axis=0) / np.sqrt(m)
        b, delta = b + level * noise(rng, m, 2), level * np.sqrt(m) * rng.uniform(0.5, 1.5)
        found = basis_pursuit_denoise(a, b, delta)
        residual = np.linalg.norm(a @ found.x - b, axis=0)
        within = residual <= 1.001 * delta + 1e-12 * np.linalg.norm(b, axis=0)
        wrong += int(np.count_nonzero((found.status == 0) & ~within))
        flagged += int(np.count_nonzero(found.status))
    results.add(problems=count, right_hand_sides=2 * count, flagged=flagged, false_certificates=wrong)
    results.bar("false certificates", wrong, 0)


def ageing(results: Results, count: int) -> Figure:
    """How surely a few probes tell that a small bundle has warmed, and what they mend; receiver operating curves."""
    scene = Scene((8, 8), stride=4)
    inverse = recover(scene.fields, ForwardInverse())
    rng = np.random.default_rng(2)
    launch = scene.bundle.launch(scene.points, WAIST)
    both = scipy.sparse.block_diag([launch, launch], format="csc")
    figure = Figure(figsize=(4.6, 3.6), layout="constrained")
    axes = figure.subplots()

    def probes(matrix: Any, number: int) -> CalibrationFields:
        inputs = noise(rng, 2 * len(scene.points), number) / 2
        clean = matrix @ inputs
        fields = (clean + scene.level * noise(rng, *clean.shape)).T.reshape(number, 2, -1)
        return replace(scene.fields, fields=fields, variance=np.full(fields.shape, scene.level**2),
                       inputs=scipy.sparse.csr_array(inputs))  # fmt: skip

    still = np.array([staleness(inverse, probes(scene.matrix, 2)).probability for _ in range(count)])
    for heating in (1e-4, 2e-4, 4e-4, 1e-3, 1e-2):
        warm = scene.bundle.disturbed(heating=heating).columns(both, faint=1e-7)
        found = [staleness(inverse, probes(warm, 2)) for _ in range(count)]
        probability = np.array([f.probability for f in found])
        levels = np.sort(np.concatenate([still, probability, [0, 1]]))
        false, true = (np.array([np.mean(p <= level) for level in levels]) for p in (still, probability))
        area = float(np.trapezoid(true, false))
        change = float(np.median([f.change for f in found]))
        refreshed = refresh(inverse, probes(warm, 20))
        z = noise(rng, 2 * len(scene.points), 20)
        errors = [float(np.linalg.norm(m.matrix @ (warm @ z) - z) / np.linalg.norm(z)) for m in (inverse, refreshed)]
        results.add(heating=heating, probes=2, area_under_curve=area, change_found=change,
                    alarms_at_5_percent=float(np.mean(probability < 0.05)), error_old=errors[0],
                    error_refreshed_by_20=errors[1])  # fmt: skip
        axes.plot(false, true, label=f"heated by {heating:g}: change {change:.3f}")
    axes.set(xlabel="false alarms", ylabel="changes noticed", title="two probes, 2 % noise")
    axes.legend(fontsize=8, loc="lower right")
    axes.grid(alpha=0.3)
    return figure


def pressed(results: Results) -> None:
    """The measured fibre, pressed further: old matrix, a fresh recovery from the probes alone, and both together."""
    states = ("5.0", "5.04", "5.12")
    matrices = [datasets.multimode_fibre(s).jones.transpose(2, 0, 3, 1).reshape(110, 110) for s in states]
    rng = np.random.default_rng(3)
    for name, true in zip(("5.04", "5.12"), matrices[1:], strict=True):
        for count in (10, 20, 40):
            x = noise(rng, 110, count)
            level = NOISE * np.sqrt((np.abs(true @ x) ** 2).mean())
            y = true @ x + level * noise(rng, 110, count)
            scaled = matrices[0] * np.vdot(matrices[0] @ x, y) / np.linalg.norm(matrices[0] @ x) ** 2
            fresh = basis_pursuit_denoise(x.T, y.T, level * np.sqrt(count)).x.T
            updated = update_matrix(matrices[0], x, y, level)
            off = [float((np.linalg.norm(a - true, axis=1) / np.linalg.norm(true, axis=1)).mean())
                   for a in (scaled, fresh, updated)]  # fmt: skip
            results.add(pressed_to=name, probes=count, error_old=off[0], error_fresh=off[1], error_updated=off[2])
            results.bar(f"{name}, {count} probes: error over the better of old and fresh", off[2] / min(off[:2]), 1.0)


def main(size: int | None = None, full: bool = False, quick: bool = False) -> None:
    """Print the tables; ``size``: points along each axis instead of 27 x 36. ``quick``: methods and solvers only."""
    results = Results("recovery")
    methods(results, size, full)
    if quick:
        solvers(results)
        results.save()
        return
    if full:
        retrieved(results, size)
    solvers(results)
    certificates(results, 1000 if full else 100)
    pressed(results)
    results.save(ageing(results, 200 if full else 40))


if __name__ == "__main__":
    main()
