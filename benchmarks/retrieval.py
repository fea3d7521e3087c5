"""Speed against error of the methods of phase retrieval on simulated bundle fields.

Random amplitudes in every fibrelet of a bundle that fills the frame, 7 planes over 50 um, seen through a finer grid,
with 0.3 % of error in the distances, fibrelets whose places are known to 20 nm and whose radii to 2 %, and a bracket of
8-bit frames with shot and read noise. Error: relative, of pixels above 5 % of the peak intensity, modulo piston. Time:
of :func:`fibre.retrieve`, one field, code compiled and geometry made before (first call apart; of 200 and more
iterations only the first call). Beside it pairs of FFTs of seven planes, measured in the same run.

``--full``: 1200 x 1200 pixels, some 9000 fibrelets. Otherwise 400 x 400.
"""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from acquisition.exposure import InverseVariance
from acquisition.merging import merge_exposures
from benchmarks.results import Results, median_seconds
from fibre import (
    Accelerated,
    Bundle,
    Defocus,
    Diversity,
    Fibrelets,
    GerchbergSaxton,
    Modal,
    TransportOfIntensity,
    retrieve,
)

PIXEL, SPAN, PLANES = 0.39e-6, 50e-6, 7
FINER, FOCUS = 2, 1.003
MARGIN = 10e-6  # dark, from the bundle to the frame's edge


def scene(
    side: int, photons: float, seed: int = 0, planes: Any = None, span: float = SPAN, pixel: float = PIXEL
) -> tuple[Bundle, Fibrelets, Diversity, np.ndarray]:
    """The bundle, what is known of its fibrelets, the images, and the true field (y, x) in photo-electrons' roots.

    ``planes``: distances, metres; None: seven over ``span``.
    """
    bundle = Bundle.hexagonal(radius=side * pixel / 2 - MARGIN, rng=seed)
    rng = np.random.default_rng(seed + 1)
    c = np.zeros((2, bundle.cores), complex)
    c[0] = rng.standard_normal(bundle.cores) + 1j * rng.standard_normal(bundle.cores)
    distances = np.linspace(-span / 2, span / 2, PLANES) if planes is None else np.asarray(planes)
    truth, images = _truth(bundle, c, side, distances, pixel)
    scale = photons / images.max()
    radiance, variance = np.empty_like(images), np.empty_like(images)
    for i, image in enumerate(images * scale):
        radiance[i], variance[i] = _camera(image, photons, rng)
    known = Fibrelets(
        bundle.centres + 20e-9 * rng.standard_normal(bundle.centres.shape),
        bundle.mode_radius * (1 + 0.02 * rng.standard_normal(bundle.cores)),
    )
    return bundle, known, Defocus(radiance, distances, bundle.wavelength, pixel, variance), truth * np.sqrt(scale)


def _truth(
    bundle: Bundle, c: np.ndarray, side: int, distances: np.ndarray, pixel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Field in focus and mean intensities of the camera's pixels, one plane after the other: frames are large."""
    images = []
    for distance in distances * FOCUS:
        fine = np.abs(bundle.image(c, (side, side), pixel, distance, oversampling=FINER, padding=1)[0]) ** 2
        images.append(fine.reshape(side, FINER, side, FINER).mean((1, 3)))
    return bundle.image(c, (side, side), pixel, padding=1)[0], np.stack(images)


def _camera(image: np.ndarray, photons: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and variance from a bracket of four 8-bit frames: only the shortest holds the peak, with an eighth
    of its photons."""
    times, read, gain = np.array([1.0, 0.5, 0.25, 0.125]), 3.0, photons / 8 / 240
    frames = []
    for t in times:
        electrons = rng.poisson(image * t) + read * rng.standard_normal(image.shape)
        frames.append(np.clip(np.rint(electrons / gain), 0, 255).astype(np.uint8))
    merged = merge_exposures(np.stack(frames), times, 255, InverseVariance(gain, read))
    variance = np.where(merged.saturated, np.inf, merged.variance)
    return np.asarray(merged.radiance, float), variance


def error(field: np.ndarray, truth: np.ndarray) -> float:
    """Relative, of the bright pixels, modulo piston."""
    bright = np.abs(truth) ** 2 > 0.05 * np.max(np.abs(truth) ** 2)
    a, b = field[bright], truth[bright]
    return float(np.linalg.norm(a * np.exp(1j * np.angle(np.vdot(a, b))) - b) / np.linalg.norm(b))


def main(size: int | None = None, full: bool = False) -> None:
    """Print the table; ``size`` is the side of the frame."""
    results = Results("retrieval")
    side = size or (1200 if full else 400)
    pair_seconds = _pair(side)
    results.add(side=side, pair_of_ffts_of_all_planes=pair_seconds)
    for photons in (1e4, 1e6) if not full else (1e4, 1e5, 1e6):
        bundle, known, stack, truth = scene(side, photons)
        sweeps = (10, 50, 200, 400)
        methods: dict[str, Any] = {f"GerchbergSaxton, {n}": _sweeps(n) for n in sweeps}
        if photons != 1e4:
            methods = {"GerchbergSaxton, 200": _sweeps(200)}
        methods |= {
            "Accelerated, 20 + 100": Accelerated(tolerance=0.0),
            "TransportOfIntensity, one step": TransportOfIntensity(iterations=0, order=1),
            "Modal, start only": Modal(known, steps=1, inner=1),
            "Modal": Modal(known),
            "Modal, focus and gains too": Modal(known, focus_spread=1e-6, gain_spread=0.02),
        }
        found: dict[str, tuple[float, float]] = {}
        for name, method in methods.items():
            # the slow ones once: compilation, a second or two, is a few per cent of them
            first, field = _once(stack, method)
            slow_one = name.startswith("Accelerated") or name in (
                "GerchbergSaxton, 200",
                f"GerchbergSaxton, {sweeps[-1]}",
            )
            runs = 0 if slow_one else 1 if "Gerchberg" in name else 5
            seconds = median_seconds(lambda m=method, d=stack: retrieve(d, m), runs) if runs else first
            found[name] = (seconds, error(field, truth))
            results.add(photons=photons, fibrelets=bundle.cores, method=name, seconds=seconds, error=found[name][1],
                        pairs=seconds / pair_seconds, first_seconds=first)  # fmt: skip
        slow, best = found["GerchbergSaxton, 200"], found["Modal"]
        text = f"{photons:g} photons"
        quickest = min(spent for name, (spent, off) in found.items() if name.startswith("Modal") and off <= slow[1])
        results.bar(f"{text}: time to the error of 200 sweeps, over theirs", quickest / slow[0], 1 / 50)
        results.bar(f"{text}: error of Modal over that of 200 sweeps", best[1] / slow[1], 1.0)
        least = min(value for name, (_, value) in found.items() if "Gerchberg" in name)
        results.bar(f"{text}: error of Modal over the least of Gerchberg-Saxton", best[1] / least, 0.5)
        if photons == 1e4:
            few, many = (found[f"GerchbergSaxton, {n}"][0] for n in sweeps[:2])
            each = (many - few) / (sweeps[1] - sweeps[0])
            results.bar("one sweep over one pair of FFTs of all planes", each / pair_seconds, 1.3)
            results.bar("transport of intensity", found["TransportOfIntensity, one step"][0], 0.04, "s")
    _wide(results)
    _calibration(results, side, *scene(side, 1e4)[1:])
    results.save(_picture(results.rows))


def _wide(results: Results) -> None:
    """Planes so far apart that the light of tens of fibrelets meets in each."""
    _, known, stack, truth = scene(200, 1e4, span=240e-6, pixel=0.72e-6)
    for name, method in {"GerchbergSaxton, 20": _sweeps(20), "Modal": Modal(known)}.items():
        first, _ = _once(stack, method)
        spent, field = _once(stack, method)
        results.add(planes_over=240e-6, fibrelets=len(known.centres), method=name, seconds=spent,
                    error=error(field, truth), first_seconds=first)  # fmt: skip


def _calibration(results: Results, side: int, known: Fibrelets, stack: Diversity, truth: np.ndarray) -> None:
    """What the fields of a calibration of 293 captures take, from a batch of eight."""
    few = 8
    assert stack.variance is not None
    assert stack.distances is not None
    images, variance = (np.broadcast_to(a, (few, *a.shape)) for a in (stack.intensities, stack.variance))
    many = Defocus(images, stack.distances, stack.wavelength, stack.pixel_size, variance)
    methods: dict[str, Any] = {
        "TransportOfIntensity, one step": TransportOfIntensity(iterations=0, order=1),
        "Modal, start and one step": Modal(known, steps=1),
        "Modal": Modal(known),
    }
    for name, method in methods.items():
        retrieve(stack, method)
        spent, field = _once(many, method)
        whole = 293 * spent / few
        results.add(captures=293, side=side, method=name, seconds=whole, error=error(field[0], truth))
        if side == 1200 and name != "Modal":
            results.bar(f"fields of a calibration, {name}", whole, 29.5 if "Transport" in name else 180, "s")


def _picture(rows: list[dict[str, Any]]) -> Figure:
    """Error against time, a colour for each method."""
    rows = [row for row in rows if "photons" in row]
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    names = list(dict.fromkeys(row["method"].split(",")[0] for row in rows))
    for row in rows:
        name = row["method"].split(",")[0]
        marker = dict(zip((1e4, 1e5, 1e6), "os^", strict=True))[row["photons"]]
        axes.plot(row["seconds"], row["error"], marker, color=f"C{names.index(name)}", mfc="none",
                  label=f"{name}, {row['photons']:.0e} photons")  # fmt: skip
        if "Gerchberg" in name and row["photons"] == 1e4:
            axes.annotate(row["method"].split(", ")[1], (row["seconds"], row["error"]), (4, 4),
                          textcoords="offset points", fontsize=7)  # fmt: skip
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    axes.set(xscale="log", yscale="log", xlabel="seconds a field", ylabel="relative error of the bright pixels")
    axes.legend(unique.values(), unique.keys(), fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    axes.grid(alpha=0.3)
    return figure


def _sweeps(count: int) -> GerchbergSaxton:
    return GerchbergSaxton(iterations=count, averaging=0, restarts=0, tolerance=0.0, coarsening=1)


def _once(stack: Any, method: Any) -> tuple[float, np.ndarray]:
    start = time.perf_counter()
    field = retrieve(stack, method).field
    return time.perf_counter() - start, field


def _pair(side: int) -> float:
    """A pair of FFTs of seven planes, one after the other as in a sweep."""
    planes = jnp.asarray(np.random.default_rng(0).standard_normal((PLANES, side, side)).astype(np.complex64))
    both = jax.jit(lambda a: jax.lax.map(lambda x: jnp.fft.ifft2(jnp.fft.fft2(x)), a))
    both(planes).block_until_ready()
    return median_seconds(lambda: both(planes).block_until_ready(), 5)


if __name__ == "__main__":
    main()
