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

import fibre
import polinfer
from acquisition.bench.scene import Scene
from acquisition.bench.simulator import SimulatedBench
from acquisition.plan import CalibrationPlan, SamplePlan
from acquisition.reporting import write_report
from acquisition.run import calibrate, capture
from polinfer import ComplexGain, Fit, Measurement, Model, Parameters, RetarderFirst, phantoms
from polinfer.degeneracy import nearest
from polinfer.validation import jones_chi_square

__all__ = ["DemoResult", "demo_scene", "report", "run_demo"]

GRID = (18, 18)


@dataclass
class DemoResult:
    """What the demo made: the truth, the Jones data, the fit, seconds by stage, and the files."""

    phantom: phantoms.Phantom
    measurement: Measurement
    fit: Fit
    seconds: dict[str, float] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)

    @property
    def jones(self) -> np.ndarray:
        """The true Jones matrices with the sample's amplitude and phase, complex (y, x, 2, 2)."""
        gain = np.asarray(self.phantom.gain)[..., None, None]
        return np.asarray(RetarderFirst().jones(self.phantom.parameters)) * gain

    @property
    def chi_square(self) -> tuple[float, int, int]:
        """Chi-square of the fitted Jones matrices modulo the gain, its degrees of freedom, and pixels counted."""
        values, freedom = jones_chi_square(self.fit, self.jones)
        return float(np.nansum(values)), int(freedom.sum()), int(np.count_nonzero(freedom))


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


def run_demo(
    folder: str | Path, seed: int = 0, progress: bool = False, grid: tuple[int, int] = GRID, page: bool = False
) -> DemoResult:
    """Simulate, capture, retrieve, recover, reconstruct and fit a sample of ``grid`` points; every record is saved in
    ``folder``. ``page``: write a report too, with posteriors, the comparison of the orderings, and texture.

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
        scene = demo_scene(seed, grid)
        bench = SimulatedBench(scene, rng=seed)
    keep(scene.phantom, "phantom.nc")
    with stage("calibration capture"):
        calibration = calibrate(bench, CalibrationPlan(grid, reference_every=24), folder / "calibration", progress)
    with stage("sample capture"):
        recording = capture(bench, SamplePlan(), folder / "sample", progress)
    method = fibre.GerchbergSaxton()
    with stage("fields of the calibration"):
        calibration_fields = fibre.retrieve_fields(calibration, method, progress=progress)
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
    result = DemoResult(scene.phantom, measurement, fit, seconds, files)
    if page:
        with stage("report"):
            files.append(_page(result, folder, scene.pitch, seed))
    return result


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
