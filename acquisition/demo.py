"""The whole line of records on a simulated bench, and how far it ends from the truth.

In: a folder and a seed. Out: every record on disk, a picture, and a :class:`DemoResult`. Called by ``polinfer demo``
and by the test of the whole chain.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.spatial

import fibre
import polinfer
from acquisition.bench.scene import CameraModel, Scene
from acquisition.bench.simulator import SimulatedBench
from acquisition.exposure import Bracket
from acquisition.plan import CalibrationPlan, SamplePlan, Step, Views
from acquisition.reporting import write_report
from acquisition.run import calibrate, capture
from fibre.coupling import clean_fibrelets
from fibre.retrieval.base import RetrievalMethod
from polinfer import ComplexGain, Fit, Measurement, Model, Parameters, RetarderFirst, phantoms
from polinfer.degeneracy import nearest
from polinfer.orderings.on_host import jones_on_host
from polinfer.validation import jones_chi_square

__all__ = ["DemoResult", "Setup", "demo_scene", "demo_setup", "full_setup", "report", "run_demo", "stages"]

GRID = (18, 18)
FULL_GRID, FULL_SIDE, FULL_PIXEL, FULL_PITCH = (27, 36), 1200, 0.39e-6, 68.2e-6 / 9
DARK = 10e-6  # metres, from the bundle to the frame's edge

# what the paper says of its stages, seconds on its hardware of 2018; phase retrieval and inference are given for one
# field and for one frame of 972 pixels
PAPER = {
    "calibration capture": "50.8 min",
    "sample capture": "24.9 s",
    "fields of the calibration": "67 s a field",
    "inverse matrix": "9.5 h",
    "fields of the sample": "67 s a field",
    "fit": "24 min",
}


@dataclass
class DemoResult:
    """What the demo made: the truth, the Jones data, the fit, seconds and error against the truth by stage, and the
    files."""

    phantom: phantoms.Phantom
    measurement: Measurement
    fit: Fit
    seconds: dict[str, float] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)

    @property
    def jones(self) -> np.ndarray:
        """The true Jones matrices with the sample's amplitude and phase, complex (y, x, 2, 2)."""
        gain = np.asarray(self.phantom.gain)[..., None, None]
        return jones_on_host(RetarderFirst(), self.phantom.parameters) * gain

    @property
    def chi_square(self) -> tuple[float, int, int]:
        """Chi-square of the fitted Jones matrices modulo the gain, its degrees of freedom, and pixels counted."""
        values, freedom = jones_chi_square(self.fit, self.jones)
        return float(np.nansum(values)), int(freedom.sum()), int(np.count_nonzero(freedom))


@dataclass(frozen=True)
class Setup:
    """A scene, the plans that it is captured with, and how its fields are retrieved."""

    scene: Scene
    calibration: CalibrationPlan
    sample: SamplePlan
    method: Callable[[fibre.Fibrelets], RetrievalMethod]


def demo_scene(seed: int, grid: tuple[int, int] = GRID) -> Scene:
    """The demo's scene: a lesion of ``grid`` points behind 547 fibrelets, seen by a 200 x 200 camera of 8 bits.

    The bench is not what the recovery believes: the sample is finer than the calibration points, every defocus is
    0.3 % longer than stated, and the phase steps err by 5 mrad.
    """
    return Scene(
        fibre.Bundle.hexagonal(rng=seed),
        phantoms.lesion(grid, rng=seed),
        focus_error=3e-3,
        step_error=5e-3,
        sample_oversampling=2,
    )


def demo_setup(seed: int, grid: tuple[int, int] = GRID) -> Setup:
    """The demo at a size that takes a minute."""
    plan = CalibrationPlan(grid, reference_every=24)
    return Setup(demo_scene(seed, grid), plan, SamplePlan(), lambda _: fibre.GerchbergSaxton())


def full_setup(seed: int, grid: tuple[int, int] = FULL_GRID, side: int = FULL_SIDE) -> Setup:
    """The paper's size: 972 points behind some 9000 fibrelets, seen by 1200 x 1200 pixels.

    Spots that are lit together are four points (30 um) apart and not nine: that needs 48 captures instead of 243.
    """
    radius = side * FULL_PIXEL / 2 - DARK
    views = Views(tuple(np.linspace(-25e-6, 25e-6, 7).tolist()), bracket=Bracket(64e-3, 4.0, 1e-3))
    scene = Scene(
        fibre.Bundle.hexagonal(radius=radius, rng=seed),
        phantoms.lesion(grid, rng=seed),
        CameraModel((side, side), FULL_PIXEL),
        FULL_PITCH,
        illumination_waist=0.9 * radius,
        reference=(0.0, radius - 5e-6),
        focus_error=3e-3,
        step_error=5e-3,
        sample_oversampling=2,
    )
    plan = CalibrationPlan(grid, FULL_PITCH, stride=4, reference_every=24, views=views)
    return Setup(scene, plan, SamplePlan(views=views), lambda fibrelets: fibre.Modal(fibrelets))


def run_demo(
    folder: str | Path,
    seed: int = 0,
    progress: bool = False,
    page: bool = False,
    setup: Setup | None = None,
) -> DemoResult:
    """Simulate, capture, retrieve, recover, reconstruct and fit a sample; every record is saved in ``folder``.

    ``page``: write a report too, with posteriors, the comparison of the orderings, and texture. ``setup``: another
    scene with its plans, None: :func:`demo_setup`.

    Captures already complete in ``folder`` are not taken again; everything later is made anew and overwritten.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    seconds: dict[str, float] = {}
    files: list[Path] = []

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - start

    def keep(record: object, name: str) -> None:
        files.append(fibre.save(record, folder / name, overwrite=True))

    with stage("simulated bench"):
        setup = setup or demo_setup(seed)
        scene = setup.scene
        bench = SimulatedBench(scene, rng=seed)
    keep(scene.phantom, "phantom.nc")
    with stage("calibration capture"):
        calibration = calibrate(bench, setup.calibration, folder / "calibration", progress)
    with stage("sample capture"):
        recording = capture(bench, setup.sample, folder / "sample", progress)
    with stage("fields of the calibration"):
        fibrelets = fibre.fibrelets_of(calibration)
        method = setup.method(fibrelets)
        calibration_fields = fibre.retrieve_fields(calibration, method, fibrelets, progress)
    keep(calibration_fields, "calibration-fields.nc")
    with stage("inverse matrix"):
        inverse = fibre.recover(calibration_fields, fibre.ForwardInverse(), progress=progress)
    keep(inverse, "inverse.nc")
    with stage("fields of the sample"):
        fields = fibre.retrieve_fields(recording, method, calibration_fields.fibrelets, progress)
    keep(fields, "sample-fields.nc")
    with stage("Jones data"):
        measurement = fibre.reconstruct(inverse, fields)
    keep(measurement, "measurement.nc")
    with stage("fit"):
        fit = polinfer.fit(Model(gain=ComplexGain(1.0)), measurement, progress=progress)
    keep(fit, "fit.nc")
    with stage("picture"):
        files.append(folder / "maps.png")
        fit.plot().savefig(files[-1], dpi=110)
    result = DemoResult(scene.phantom, measurement, fit, seconds, files=files)
    result.errors.update(_errors(bench, setup, calibration_fields, fields, inverse, result))
    if page:
        with stage("report"):
            files.append(_page(result, folder, scene.pitch, seed))
    return result


def _errors(
    bench: SimulatedBench,
    setup: Setup,
    calibration: fibre.CalibrationFields,
    sample: fibre.RecordingFields,
    inverse: fibre.Inverse,
    result: DemoResult,
) -> dict[str, str]:
    """How far each stage is from the truth. Fields: of the products of neighbouring amplitudes beside the reference
    spot, which no common phase changes; of the inverse: of true fields sent through it, but for an amplitude and a
    phase a point, which the blank takes out."""
    bundle, plan = bench.scene.bundle, setup.calibration
    away, nearest_core = scipy.spatial.cKDTree(bundle.centres).query(calibration.fibrelets.centres)
    found = (away < 1e-6) & clean_fibrelets(calibration)
    unit = np.sqrt(bench.scene.spot_power * bench.scene.camera.quantum_efficiency)
    steps = [step for step in plan.captures if step.kind == "spots"]
    some = np.unique(np.linspace(0, len(steps) - 1, 12).astype(int))

    def truth(step: Step, illumination: np.ndarray) -> np.ndarray:
        return unit * bench.amplitudes(step, illumination, plan.points)[:, nearest_core]

    def off(retrieved: list[np.ndarray], true: list[np.ndarray]) -> str:
        pairs = scipy.spatial.cKDTree(calibration.fibrelets.centres).query_pairs(6e-6, output_type="ndarray")
        pairs = pairs[found[pairs].all(1)]
        if len(pairs) == 0:
            return ""
        first, second = pairs.T
        a, b = (np.stack([f[:, first] * f[:, second].conj() for f in fields]) for fields in (retrieved, true))
        return f"{np.linalg.norm(a - b) / np.linalg.norm(b):.3f}"

    reference = calibration.reference
    errors = {
        "fields of the calibration": off(
            [calibration.fields[c] + reference for c in some], [truth(steps[c], plan.illumination) for c in some]
        )
    }
    states = [step for step in setup.sample.captures if step.kind == "sample"]
    seen = [truth(step, setup.sample.illumination) for step in states]
    errors["fields of the sample"] = off([f + reference for f in sample.fields], seen)
    alone = truth(Step("reference-0", "reference"), plan.illumination)
    distal = result.jones @ setup.sample.illumination
    sent = inverse.matrix @ np.stack([(f - alone).ravel() for f in seen], axis=1)
    images = sent.reshape(2, -1, len(states)).swapaxes(0, 1)
    wanted = distal.reshape(-1, 2, len(states))
    scale = (images.conj() * wanted).sum((1, 2)) / (np.abs(images) ** 2).sum((1, 2))
    images = images * scale[:, None, None]
    errors["inverse matrix"] = f"{np.linalg.norm(images - wanted) / np.linalg.norm(wanted):.3f}"
    chi_square, freedom, _ = result.chi_square
    errors["fit"] = f"chi-square {chi_square / freedom:.2f}"
    return errors


def _page(result: DemoResult, folder: Path, pitch: float, seed: int) -> Path:
    chi_square, freedom, pixels = result.chi_square
    ratio = chi_square / freedom
    note = (
        f"A lesion behind a simulated fibre, scene {seed}. Against the truth, the fitted Jones matrices have a "
        f"chi-square of {ratio:.2f} per degree of freedom, from {pixels} pixels; 1 means that the noise is as stated."
    )
    seconds, title = result.seconds, "polinfer demo"
    labels = result.phantom.labels
    return write_report(folder, title=title, seconds=seconds, pixel_size=pitch, rng=seed, notes=(note,), labels=labels)


def stages(result: DemoResult, echo: Callable[[str], None]) -> None:
    """Print seconds and error against the truth of every stage, and what the paper says of it."""
    echo(f"{'Seconds by stage':28s}{'here':>8s}{'error':>18s}{'paper, 2018':>16s}")
    for name, value in result.seconds.items():
        echo(f"{name:28s}{value:8.1f}{result.errors.get(name, ''):>18s}{PAPER.get(name, ''):>16s}")
    echo(f"{'Total':28s}{sum(result.seconds.values()):8.0f}")
    echo("(captures are simulated here and were exposed there; errors are relative, docs: howto-simulated-bench)\n")


def report(result: DemoResult, echo: Callable[[str], None]) -> None:
    """Print true against recovered parameters, and the chi-square of the Jones matrices."""
    fit = result.fit
    # of the equivalent sets of the true parameters, the one nearest to the fit
    truth = nearest(polinfer.orbit(result.phantom.parameters), fit.parameters)
    echo(f"{'':22s}{'true':>18s}{'recovered':>18s}{'rms error':>12s}{'stated std':>12s}{'rms of error/std':>18s}")
    for name in Parameters._fields:
        unit = 1.0 if name == "diattenuation" else 180 / np.pi
        period = 2.0**0.5 * 1e9 if name == "diattenuation" else (np.pi if name.endswith("angle") else 2 * np.pi)
        true, found, std = (np.asarray(getattr(p, name)) for p in (truth, fit.parameters, fit.std))
        error = np.remainder(found - true + period / 2, period) - period / 2
        known = np.isfinite(error) & np.isfinite(std) & ((fit.status & int(polinfer.Status.unidentified(name))) == 0)
        true, found, error, std = (x[known] * unit for x in (true, found, error, std))
        echo(
            f"{name + ('' if unit == 1 else ' / deg'):28s}"
            f"{np.median(true):7.2f} +-{true.std():5.2f}{np.median(found):11.2f} +-{found.std():5.2f}"
            f"{np.sqrt(np.mean(error**2)):10.3f}{np.median(std):12.3f}{np.sqrt(np.mean((error / std) ** 2)):18.2f}"
        )
    chi_square, freedom, pixels = result.chi_square
    echo(
        f"Jones matrices modulo gain: chi-square per degree of freedom {chi_square / freedom:.2f} "
        f"({pixels} pixels, {freedom} degrees of freedom)"
    )
    for flag in polinfer.Status:
        count = int(np.count_nonzero(fit.status & int(flag)))
        if count:
            echo(f"  {flag.name}: {count} pixels")
