"""Rows of the transmission matrix from intensities alone, against the number of intensities; and a whole calibration.

Gaussian rows of 64 elements and rows of a simulated bundle (points on a grid of 8 x 8, both polarisations, of which a
fibrelet sees those within a few coupling lengths), complex Gaussian inputs, 40 dB: the spectral start, the variational
algorithm without and with what is known of the coupling, and message passing for sparse rows; mean correlation with the
true row up to its phase. The whole calibration: 40 random patterns in three states on the simulated bench (10 x 10
points, 253 fibrelets), fields by intensities alone and by retrieval of every capture, against the true ones.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace

import jax
import numpy as np
import scipy.spatial
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from acquisition import CalibrationPlan, PatternPlan, SimulatedBench, calibrate
from acquisition.demo import demo_scene
from benchmarks.results import Results
from fibre import Bundle, GerchbergSaxton, IntensityOnly, Modal, retrieve_fields, rows_from_intensities
from fibre.fields import fibrelets_of

LEVEL = 0.01  # 40 dB


def noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Complex, E|n|^2 = 1."""
    return np.asarray((rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2))


def overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of rows, up to a phase of each."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.asarray(np.abs((a.conj() * b).sum(1)) / np.maximum(lengths, 1e-300))


def of_a_bundle(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (count, 128) of fibrelets near the middle of the grid, and the mean power at the distances of the points."""
    plan = CalibrationPlan((8, 8), stride=4)
    bundle = Bundle.hexagonal(radius=25e-6, rng=0)
    launch = bundle.launch(plan.points, 2.5e-6)
    matrix = np.concatenate(
        [bundle.transmit((launch @ np.eye(64)[j]) * np.eye(2)[p][:, None])[None] for p in range(2) for j in range(64)]
    )
    chosen = np.argsort(np.hypot(*bundle.centres.T))[:count]
    rows = matrix[:, 0, chosen].T
    away = np.hypot(*(bundle.centres[chosen][:, None] - plan.points).transpose(2, 0, 1))
    prior = np.exp(-np.tile(away, 2) / 0.95e-6)
    return rows, prior


def curves(results: Results, count: int) -> Figure:
    """The table and the picture of correlation against intensities an unknown."""
    gaussian = noise(np.random.default_rng(0), count, 64)
    bundle, prior = of_a_bundle(count)
    scenes = {"Gaussian rows": (gaussian, None), "rows of a bundle": (bundle, prior)}
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    for axes, (scene, (rows, local)) in zip(figure.subplots(1, 2, sharey=True), scenes.items(), strict=True):
        ways = {"spectral start": ("spectral", None), "variational": ("variational", None),
                "message passing": ("message_passing", None)}  # fmt: skip
        if local is not None:
            ways["variational, coupling known"] = ("variational", local)
        ratios = (0.5, 1, 1.5, 2, 3, 4, 6, 8)
        for name, (algorithm, tau) in ways.items():
            means = []
            for ratio in ratios:
                rng = np.random.default_rng(1)
                x = noise(rng, rows.shape[1], int(ratio * rows.shape[1]))
                clean = np.abs(rows @ x) ** 2
                level = LEVEL * np.sqrt((clean**2).mean(1, keepdims=True))
                seen = clean + level * rng.standard_normal(clean.shape)
                start = time.perf_counter()
                found = rows_from_intensities(x, seen, np.broadcast_to(level**2, seen.shape), tau, algorithm)
                spent = time.perf_counter() - start
                same = overlap(rows, found.values)
                means.append(same.mean())
                silent = (found.status == 0) & (same < 0.9)
                results.add(rows=scene, way=name, intensities_an_unknown=ratio, mean_overlap=float(same.mean()),
                            least=float(same.min()), above_99=float(np.mean(same > 0.99)),
                            ms_a_row=1e3 * spent / len(rows), wrong_and_not_flagged=int(silent.sum()))  # fmt: skip
                if scene == "Gaussian rows" and ratio == 8 and algorithm != "spectral":
                    results.bar(f"least overlap, {name}, 64 x 64, 8 n", float(same.min()), 0.99, at_least=True)
            axes.plot(ratios, means, "o-", label=name, markersize=4)
        axes.set(xlabel="intensities an unknown", title=f"{scene}, 40 dB")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="lower right")
    figure.axes[0].set_ylabel("mean correlation with the true row")
    return figure


def whole(results: Results) -> None:
    """Fields of a calibration of random patterns, with and without retrieval."""
    scene = replace(demo_scene(0, (10, 10)), bundle=Bundle.hexagonal(radius=38e-6, rng=0), reference=(0.0, 33e-6))
    plan = PatternPlan((10, 10), patterns=40)
    with tempfile.TemporaryDirectory() as folder:
        calibration = calibrate(SimulatedBench(scene, rng=0), plan, folder)
        fibrelets = fibrelets_of(calibration)
        launch = scene.bundle.launch(plan.points, scene.spot_waist)
        inputs = plan.inputs.toarray().reshape(2, len(plan.points), -1)
        own = scipy.spatial.cKDTree(scene.bundle.centres).query(fibrelets.centres)[1]
        true = np.sqrt(scene.spot_power) * np.stack(
            [scene.bundle.transmit((launch @ inputs[:, :, c].T).T)[:, own] for c in range(inputs.shape[2])]
        )
        ways = {
            "IntensityOnly": lambda: IntensityOnly(fibrelets=fibrelets).fields(calibration),
            "GerchbergSaxton": lambda: retrieve_fields(calibration, GerchbergSaxton(), fibrelets),
            "Modal": lambda: retrieve_fields(calibration, Modal(fibrelets), fibrelets),
        }
        for name, way in ways.items():
            start = time.perf_counter()
            found = way()
            spent = time.perf_counter() - start
            spot = (np.abs(found.reference) ** 2).sum(0)
            used = spot < 0.03 * spot.max()
            a, b = found.fields[..., used], true[..., used]
            off = a * np.exp(1j * np.angle(np.vdot(a, b))) - b
            results.add(fields_of=f"{inputs.shape[2]} captures", way=name, seconds=spent,
                        error=float(np.linalg.norm(off) / np.linalg.norm(b)))  # fmt: skip


def main(full: bool = False) -> None:
    """Print the tables; ``full``: 64 rows a point instead of 16."""
    results = Results("intensities")
    with threadpool_limits(1, user_api="blas"):
        figure = curves(results, 64 if full else 16)
    whole(results)
    results.save(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
