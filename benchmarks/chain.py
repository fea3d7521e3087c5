"""The whole chain against its truth, over seeds: chi-square per degree of freedom of the fitted Jones matrices, and of
those parameters whose Cramer-Rao bound is below 0.1.

Without drift as the demo runs; and with a piston and a tilt that walk (0.2 rad and 130 rad/m a root second: 0.13 rad at
the facet's edge in eight minutes; ``--full``: three times as fast too), 8.3 s a capture, a reference a minute,
followed or not.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from typing import Literal

import jax
import numpy as np

import polinfer
from acquisition import CalibrationPlan, SamplePlan, SimulatedBench, calibrate, capture
from acquisition.demo import DemoResult, demo_scene, run_demo
from benchmarks.results import Results
from fibre import ForwardInverse, GerchbergSaxton, reconstruct, recover, retrieve_fields
from polinfer import ComplexGain, Fit, Model, RetarderFirst, Status
from polinfer.validation import jones_chi_square, standardised_errors

SEEDS = 6
BOUND = 0.1  # what is determined worse than this has no Gaussian error


def drifting(seed: int, walk: float, drift: Literal["track"] | None, folder: str) -> tuple[Fit, np.ndarray]:
    """The fit of a sample behind a fibre that moves, and its true Jones matrices."""
    scene = replace(demo_scene(seed), piston_walk=0.2, tilt_walk=walk, image_time=0.7)
    bench = SimulatedBench(scene, rng=seed)
    calibration = calibrate(bench, CalibrationPlan((18, 18)), folder + "/calibration")
    recording = capture(bench, SamplePlan(references=4), folder + "/sample")
    method = GerchbergSaxton()
    fields = retrieve_fields(calibration, method, drift=drift)
    sample = retrieve_fields(recording, method, fields, drift=drift)
    fit = polinfer.fit(Model(gain=ComplexGain(1.0)), reconstruct(recover(fields, ForwardInverse()), sample))
    gain = np.asarray(scene.phantom.gain)[..., None, None]
    return fit, np.asarray(RetarderFirst().jones(scene.phantom.parameters)) * gain


def determined(result: DemoResult) -> tuple[float, int, int]:
    """Chi-square of the parameters whose bound at the truth is below 0.1, their number, and pixels that have some."""
    fit, data = result.fit, result.measurement
    assert fit.gain is not None
    sigma = np.asarray(data.sigma) / np.abs(np.asarray(fit.gain))
    bounds = polinfer.cramer_rao_bound(fit.model, result.phantom.parameters, data.illumination, sigma)
    errors = np.stack(standardised_errors(fit, result.phantom.parameters))
    chosen = (np.stack(bounds) < BOUND) & np.isfinite(errors)
    return float((errors[chosen] ** 2).sum()), int(chosen.sum()), int(chosen.any(0).sum())


def main(full: bool = False) -> None:
    """Print the table."""
    results = Results("chain")
    totals = np.zeros((2, 3))  # of the Jones matrices and of the parameters: chi-square, degrees of freedom, pixels
    for seed in range(SEEDS):
        with tempfile.TemporaryDirectory() as folder:
            result = run_demo(folder, seed)
        chi_square, freedom, pixels = result.chi_square
        told = determined(result)
        totals += [result.chi_square, told]
        light = np.sqrt((np.abs(result.measurement.illumination) ** 2).sum(-2).mean(-1))
        results.add(
            seed=seed,
            seconds=sum(result.seconds.values()),
            chi_square_per_degree=chi_square / freedom,
            pixels=pixels,
            bad_fit=int(np.count_nonzero(result.fit.status & int(Status.BAD_FIT))),
            relative_sigma=float(np.median(result.measurement.sigma / light)),
            of_parameters=told[0] / told[1],
        )
    values = [row["chi_square_per_degree"] for row in results.rows]
    print(f"chi-square per degree of freedom: {min(values):.2f} to {max(values):.2f}, mean {np.mean(values):.2f}")
    for name, (value, degrees, pixels) in zip(("Jones matrices", "parameters"), totals, strict=True):
        claim = f"{pixels:.0f} pixels, {name}: chi-square a degree"
        results.bar(claim, value / degrees, 1.25)
        results.bar(claim, value / degrees, 0.8, at_least=True)
    figure = results.lines("seconds", "chi_square_per_degree", "seed")
    for walk in (130.0, 400.0) if full else (130.0,):
        ways: tuple[Literal["track"] | None, ...] = ("track", None)
        for drift in ways:
            total = np.zeros(3)
            for seed in range(SEEDS):
                with tempfile.TemporaryDirectory() as folder:
                    fit, true = drifting(seed, walk, drift, folder)
                chi, freedom = jones_chi_square(fit, true)
                total += [np.nansum(chi), freedom.sum(), np.count_nonzero(freedom)]
                results.add(tilt_walk=walk, drift=drift or "not followed", drift_seed=seed,
                            chi_square_per_degree=float(np.nansum(chi) / freedom.sum()),
                            sigma=float(np.median(fit.sigma)))  # fmt: skip
            if drift:
                results.bar(f"with drift, {total[2]:.0f} pixels: chi-square a degree", total[0] / total[1], 1.25)
                results.bar(f"with drift, {total[2]:.0f} pixels: chi-square a degree", total[0] / total[1], 0.8,
                            at_least=True)  # fmt: skip
    results.save(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
