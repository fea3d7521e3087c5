"""From the raw images of one sample to its maps at the paper's size: 33 images of 1200 x 1200, 972 points.

A bundle that fills the frame, its inverse from calibration fields with 2 % of noise, a lesion finer than the points,
focus 0.3 % and phase steps 5 mrad off. The blank was recorded before, as in a series of samples. Timed, in turn, code
compiled and geometry made before: the fields of the three captures, the merge of their brackets (two to four frames an
image) with them, the Jones data, the fit, and posteriors instead of it; beside them one pair of FFTs of a frame and the
paper's own figures. "one step": one Gauss-Newton step of four conjugate gradients, on a grid of 0.6 mode radii
instead of half a radius; "to the end": until it changes no more.

Errors: chi-square per degree of freedom of the fitted Jones matrices against the truth, and the noise that the data
state, relative to the light.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

import jax
import numpy as np
import scipy.fft
import scipy.sparse

import polinfer
from acquisition import CalibrationPlan, SamplePlan, SimulatedBench, Step
from acquisition.demo import FULL_GRID, FULL_SIDE, full_setup
from acquisition.images import Held, expose, merged_images
from benchmarks.results import Results
from fibre import (
    Bundle,
    CalibrationFields,
    Fibrelets,
    ForwardInverse,
    Inverse,
    Modal,
    Recording,
    RecordingFields,
    reconstruct,
    recover,
    retrieve_fields,
    retrieve_sample,
)
from polinfer import ComplexGain, Gibbs, Measurement, Model, RetarderFirst
from polinfer.validation import jones_chi_square

STRIDE, WAIST, NOISE = 9, 2.5e-6, 0.02
SAMPLER = Gibbs(effective=1000, evidence=False)
STAGES = ("fields", "jones", "fit", "posterior")
PAPER = {"fields": 3 * 67.0, "fit": 24 * 60.0}  # seconds, on its hardware of 2018


@dataclass
class Sample:
    """raw: of the sample. before: the fields of an earlier recording, for its blank. jones: the truth."""

    bench: SimulatedBench
    plan: SamplePlan
    inverse: Inverse
    raw: Held
    before: RecordingFields
    jones: np.ndarray


def calibrated(
    bundle: Bundle, plan: CalibrationPlan, reference: np.ndarray, power: float, seed: int
) -> CalibrationFields:
    """The true fields of a calibration with noise; ``power``: of a spot, ``reference``: complex (2, m)."""
    rng = np.random.default_rng(seed)
    launch = bundle.launch(plan.points, WAIST)
    matrix = bundle.columns(scipy.sparse.block_diag([launch, launch], format="csc"), faint=1e-7)
    clean = (scipy.sparse.csr_array(matrix) @ plan.inputs).toarray().T.reshape(-1, 2, bundle.cores)
    clean *= power**0.5
    level = NOISE * float(np.sqrt((np.abs(clean) ** 2).mean()))
    noise = rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)
    return CalibrationFields(
        clean + level * noise / np.sqrt(2), np.full(clean.shape, level**2), reference * power**0.5, 1.0, 0.0,
        Fibrelets(bundle.centres, bundle.mode_radius), plan.inputs, plan.points, plan.grid, np.eye(2, 3),
    )  # fmt: skip


def exposed(bench: SimulatedBench, plan: SamplePlan, kind: str) -> Held:
    """Raw frames of the captures of one kind."""
    steps = [step for step in plan.captures if step.kind == kind]
    return Held({step.id: expose(bench, step, plan.views, plan.illumination, None) for step in steps})


def sample(seed: int = 0, side: int = FULL_SIDE, grid: tuple[int, int] = FULL_GRID) -> Sample:
    """One sample and all that was there before it."""
    setup = full_setup(seed, grid, side)
    scene, plan, bundle = setup.scene, setup.sample, setup.scene.bundle
    bench = SimulatedBench(scene, rng=seed)
    blank, frames, references = (exposed(bench, plan, kind) for kind in ("blank", "sample", "reference"))
    fibrelets = Fibrelets(bundle.centres, bundle.mode_radius)
    images, *others = (merged_images(bench, plan.views, raw, raw.times) for raw in (frames, blank, references))
    recording = Recording(images, plan.illumination, *others)
    before = retrieve_fields(recording, Modal(fibrelets), fibrelets, progress=True)
    spot = bench.amplitudes(Step("reference-0", "reference"), plan.illumination, None)
    design = CalibrationPlan(grid, pitch=scene.pitch, stride=STRIDE)
    calibration = calibrated(bundle, design, spot, scene.spot_power, seed)
    inverse = recover(calibration, ForwardInverse(), progress=True)
    gain = np.asarray(scene.phantom.gain)[..., None, None]
    jones = np.asarray(RetarderFirst().jones(scene.phantom.parameters)) * gain
    return Sample(bench, plan, inverse, frames, before, jones)


def main(size: int | None = None, full: bool = False) -> None:
    """Print the table; ``size``: pixels along a side of the frame instead of 1200, with fewer points."""
    results = Results("maps")
    side = size or FULL_SIDE
    points = FULL_GRID if size is None else (9, 9)
    made = sample(0, side, points)
    calibration, model = made.inverse.calibration, Model(gain=ComplexGain(1.0))
    frame = np.random.default_rng(0).standard_normal((side, side)).astype(np.complex64)
    workers = os.cpu_count() or 1
    ways = {
        "one step": Modal(calibration.fibrelets, steps=1, inner=4, coarsening=2.5),
        "to the end": Modal(calibration.fibrelets),
    }
    spent: dict[str, dict[str, list[float]]] = {name: {} for name in ways}
    pair, errors = [], {}
    for repeat in range(1 + (9 if full else 5)):
        for name, method in ways.items():
            times: list[float] = [time.perf_counter()]

            def lap(times: list[float] = times) -> None:
                times.append(time.perf_counter())

            images = merged_images(made.bench, made.plan.views, made.raw, made.raw.times)
            fields = retrieve_sample(images, method, calibration, made.before)
            lap()
            measurement = reconstruct(made.inverse, fields)
            lap()
            fit = polinfer.fit(model, measurement)
            lap()
            # as the engine works in single precision
            both = (np.asarray(x, np.complex64) for x in (measurement.illumination, measurement.response))
            sample_of = Measurement(*both, sigma=np.asarray(measurement.sigma, np.float32))
            draws = polinfer.sample(model, sample_of, SAMPLER, chains=4, draws=1250, rng=repeat)
            lap()
            start = time.perf_counter()
            scipy.fft.ifft2(scipy.fft.fft2(frame, workers=workers), workers=workers)
            pair.append(time.perf_counter() - start)
            values, freedom = jones_chi_square(fit, made.jones)
            light = np.sqrt((np.abs(measurement.illumination) ** 2).sum(-2).mean(-1))
            errors[name] = (float(np.nansum(values) / freedom.sum()), float(np.median(fit.sigma / light)),
                            int(np.count_nonzero(draws.status & int(polinfer.Status.NOT_CONVERGED))))  # fmt: skip
            if repeat:
                for stage, seconds in zip(STAGES, np.diff(times), strict=True):
                    spent[name].setdefault(stage, []).append(float(seconds))
    unit = float(np.median(pair))
    for name in ways:
        medians = {stage: float(np.median(values)) for stage, values in spent[name].items()}
        to_map = sum(value for stage, value in medians.items() if stage != "posterior")
        to_draws = to_map - medians["fit"] + medians["posterior"]
        results.add(way=name, **{stage: round(value, 3) for stage, value in medians.items()}, seconds_map=to_map,
                    pairs_map=to_map / unit, seconds_posterior=to_draws, pairs_posterior=to_draws / unit,
                    chi_square=errors[name][0], relative_sigma=errors[name][1],
                    not_mixed=errors[name][2])  # fmt: skip
        if name == "one step" and size is None:
            results.bar("raw to maps", to_map, 2.0, "s")
            results.bar("raw to posteriors", to_draws, 4.0, "s")
            results.bar("paper's fields over ours", PAPER["fields"] / medians["fields"], 1.0, at_least=True)
    frames = sum(len(image) for name in made.raw.times for image in made.raw.load(name)[0])
    results.add(pair_of_ffts_milliseconds=1e3 * unit, frames=frames, fibrelets=len(calibration.fibrelets.centres),
                points=len(calibration.points), paper_fields_seconds=PAPER["fields"],
                paper_fit_seconds=PAPER["fit"])  # fmt: skip
    results.save()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
