"""Is a tilt between the arms found as well as it can be, and what does it cost?

A retarder near half a wave, turned, under a phase plane of the second arm, 64 x 64 pixels, three balanced states:
errors of retardance, of its angle and of the slopes against the Cramer-Rao bounds with the tilt unknown, with
``TiltPlane``, ``RotatedBasis`` (window 3 x 5) and no correction. Errors are those from the nearest of the eight
equivalent truths and of the two branches of the piston. Then angles at which nothing can be known; an edge; and the
time beside a plain fit.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

import polinfer
from benchmarks import scenes
from benchmarks.results import Results, alternating_seconds
from polinfer import Measurement, Model, Parameters, RotatedBasis, Status, TiltPlane, Window

SHAPE = (64, 64)
ANGLES = np.radians([6.0, 20.0, 33.0, 45.0, 62.0, 80.0])
SLOPES = (0.0, 1.0, 6.0, 20.0)
SIGMAS = (0.02, 0.05, 0.1, 0.2)
DIATTENUATIONS = (0.03, 0.1)
FRAMES = 12
RIVAL_ROWS = 16  # of the first frame of a row: the window takes long, and they are far from the bound
RIVALS = {"RotatedBasis": Model(neighbours=Window(3, 5), misalignment=RotatedBasis()), "none": Model()}
TILTED = Model(misalignment=TiltPlane())


def plane(shape: tuple[int, int], piston: float, rows: float, columns: float) -> np.ndarray:
    """Phase of the second arm at every pixel; slopes from edge to edge."""
    y, x = ((np.arange(n) + 0.5) / n - 0.5 for n in shape)
    return piston + rows * y[:, None] + columns * x


def errors(found: Parameters, truth: Parameters) -> np.ndarray:
    """Errors of retardance and its angle ``(2, pixels)``, from the nearest copy of the truth; the better branch."""
    best = np.full((2, np.size(found.retardance)), np.inf)
    for sign in (1, -1):
        branch = truth._replace(
            retardance_angle=sign * np.asarray(truth.retardance_angle),
            diattenuation_angle=sign * np.asarray(truth.diattenuation_angle),
        )
        copies = polinfer.orbit(Parameters(*(np.ravel(np.broadcast_to(x, found.retardance.shape)) for x in branch)))
        retardance = _wrapped(np.ravel(found.retardance) - copies.retardance, 2 * np.pi)
        angle = _wrapped(np.ravel(found.retardance_angle) - copies.retardance_angle, np.pi)
        nearest = np.argmin(retardance**2 + 4 * angle**2, axis=0)[None]
        both = np.stack([np.take_along_axis(x, nearest, axis=0)[0] for x in (retardance, angle)])
        if np.sum(both**2) < np.sum(best**2):
            best = both
    return best


def _wrapped(x: np.ndarray, period: float) -> np.ndarray:
    return x - period * np.round(x / period)


def _frame(diattenuation: float, sigma: float, slope: float, number: int, shape: tuple[int, int] = SHAPE) -> Any:
    """Truth, tilt and data of one frame."""
    rng = np.random.default_rng([int(1000 * diattenuation), int(1000 * sigma), int(slope), number])
    truth = Parameters(
        np.full(shape, diattenuation), rng.uniform(-1.5, 1.5), rng.uniform(2.6, 2.9), ANGLES[number % len(ANGLES)], 0.0
    )
    direction = rng.uniform(0, 2 * np.pi)
    slopes = slope * np.array([np.cos(direction), np.sin(direction)])
    phase = plane(shape, rng.uniform(-1.5, 1.5), *slopes)
    data = polinfer.simulate(Model(), truth, scenes.balanced_states(), sigma, rng=rng, tilt=phase)
    return truth, slopes, data


def main(size: int | None = None, full: bool = False, quick: bool = False) -> None:
    """Run. ``size`` is the number of frames in a row of the table. ``quick``: one diattenuation and noise, and the
    edge."""
    results = Results("misalignment")
    frames = size or (4 * FRAMES if full else FRAMES)
    worst = {"retardance": 0.0, "retardance angle": 0.0}
    slopes: list[float] = []
    rows = (DIATTENUATIONS[-1:], SIGMAS[-1:], SLOPES) if quick else (DIATTENUATIONS, SIGMAS, SLOPES)
    for diattenuation, sigma, slope in product(*rows):
        row, ratios = _row(diattenuation, sigma, slope, frames)
        slopes += ratios
        for name, key in (("retardance", "retardance"), ("retardance angle", "angle")):
            worst[name] = max(worst[name], row[f"TiltPlane {key} / bound"])
        results.add(**row)
    for name, ratio in worst.items():
        results.bar(f"RMS error of {name} over the bound, worst row", ratio, 1.1)
    results.bar(f"RMS error of slopes over their bound, {len(slopes)} slopes", float(np.sqrt(np.mean(slopes))), 1.1)
    if not quick:
        _unknown(results)
    edge = _edge(results)
    if not quick:
        _time(results, 256 if not size else 128)
    results.save(_picture(edge))


def _row(diattenuation: float, sigma: float, slope: float, frames: int) -> tuple[dict[str, Any], list[float]]:
    """Errors over bounds of one kind of scene, and the squared errors of its slopes over their squared bounds."""
    squares: dict[str, list[np.ndarray]] = {"TiltPlane": [], **{name: [] for name in RIVALS}}
    bounds: dict[str, list[np.ndarray]] = {name: [] for name in squares}
    ratios: list[float] = []
    flagged = 0
    for number in range(frames):
        truth, slopes, data = _frame(diattenuation, sigma, slope, number)
        bound = polinfer.cramer_rao_bound(TILTED, truth, scenes.balanced_states(), sigma)
        limit = np.stack([bound.retardance[0, 0] ** 2, bound.retardance_angle[0, 0] ** 2])
        found = polinfer.fit(TILTED, data)
        least = polinfer.tilt_bound(TILTED, truth, scenes.balanced_states(), sigma)
        assert found.tilt is not None
        ratios += list(((found.tilt.coefficients[1:] - slopes) / least[1:]) ** 2)
        flagged += int(np.any(found.status & int(Status.TILT_UNIDENTIFIED)))
        fits = {"TiltPlane": found}
        if number < 1:
            part = Measurement(data.illumination, data.response[:RIVAL_ROWS], data.sigma[:RIVAL_ROWS])
            fits |= {name: polinfer.fit(model, part) for name, model in RIVALS.items()}
        for name, result in fits.items():
            own = Parameters(*(x if np.ndim(x) == 0 else x[: len(result.status)] for x in truth))
            squares[name].append(np.mean(errors(result.parameters, own) ** 2, axis=1))
            bounds[name].append(limit)
    row: dict[str, Any] = {"D": diattenuation, "sigma": sigma, "slope": slope, "frames": frames}
    for name, values in squares.items():
        ratio = np.sqrt(np.mean(values, axis=0) / np.mean(bounds[name], axis=0))
        row |= {f"{name} retardance / bound": float(ratio[0]), f"{name} angle / bound": float(ratio[1])}
    row |= {"slopes / bound": float(np.sqrt(np.mean(ratios))), "frames flagged": flagged}
    return row, ratios


def _unknown(results: Results) -> None:
    """Half-wave plates along the axes: nothing tells the tilt, and that is the right answer."""
    for angle, retardance in product((0.0, 30.0, 90.0, 180.0), (np.pi, 2.7)):
        truth = Parameters(np.full(SHAPE, 0.03), 0.6, retardance, np.radians(angle), 0.0)
        data = polinfer.simulate(
            Model(), truth, scenes.balanced_states(), 0.05, rng=1, tilt=plane(SHAPE, 0.4, 3.0, 6.0)
        )
        found = polinfer.fit(TILTED, data)
        assert found.tilt is not None
        error = np.sqrt(np.mean(errors(found.parameters, truth) ** 2, axis=1))
        flags = Status(int(np.bitwise_or.reduce(found.status.ravel())))
        told = [flag.name for flag in Status if flag in flags and flag]
        results.add(**{"angle": angle, "eta": retardance, "retardance error": error[0], "angle error": error[1],
                       "tilt": "unknown" if Status.TILT_UNIDENTIFIED in flags else "found",
                       "probability": float(found.tilt.probability), "flags": " ".join(map(str, told))})  # fmt: skip


def _width(profile: np.ndarray) -> float:
    """Distance between 10 and 90 % of a step in a line of pixels, interpolated linearly."""
    low, high = np.median(profile[: len(profile) // 4]), np.median(profile[-len(profile) // 4 :])
    share = (profile - low) / (high - low)
    fine = np.linspace(0, len(profile) - 1, 200 * len(profile))
    values = np.interp(fine, np.arange(len(profile)), share)
    return float(fine[values > 0.9][0] - fine[values < 0.1][-1])


def _edge(results: Results) -> dict[str, Any]:
    """Two retarders side by side, tilted by 1 rad: what is left of the edge."""
    shape = (24, 64)
    retardance = np.where(np.arange(shape[1]) < shape[1] // 2, 1.4, 2.7) * np.ones(shape)
    truth = Parameters(np.full(shape, 0.05), 0.6, retardance, 0.5, 0.0)
    data = polinfer.simulate(Model(), truth, scenes.balanced_states(), 0.02, rng=1, tilt=plane(shape, 0.1, 0.3, 1.0))
    maps = {"truth": retardance}
    for name, model in {"TiltPlane": TILTED, **RIVALS}.items():
        found = polinfer.fit(model, data).parameters
        maps[name] = np.abs(found.retardance)
        width = _width(np.median(maps[name], axis=0))
        results.add(**{"edge": name, "10-90 % width (pixels)": width})
        if name == "TiltPlane":
            results.bar("width of the edge with TiltPlane, pixels", width, 1.0)
    return maps


def _time(results: Results, side: int) -> None:
    """Beside a plain fit of the same scene without a tilt."""
    shape = (side, side)
    for dtype in ("complex64", "complex128"):
        truth = polinfer.phantoms.lesion(shape, rng=1).parameters
        states = scenes.balanced_states()
        data = {
            name: polinfer.simulate(Model(), truth, states, 0.02, rng=1, tilt=phase)
            for name, phase in (("plain", np.zeros(shape)), ("tilted", plane(shape, 0.3, 6.0, -20.0)))
        }
        made = {
            name: Measurement(states.astype(dtype), x.response.astype(dtype), np.float64(0.02))
            for name, x in data.items()
        }
        works = {
            "plain": lambda made=made: polinfer.fit(Model(), made["plain"]),
            "tilted": lambda made=made: polinfer.fit(TILTED, made["tilted"]),
        }
        for work in works.values():
            work()
        times = alternating_seconds(works, 7)
        ratio = float(np.median(times["tilted"]) / np.median(times["plain"]))
        results.add(**{"pixels": side * side, "dtype": dtype, "plain fit (ms)": 1e3 * float(np.median(times["plain"])),
                       "TiltPlane (ms)": 1e3 * float(np.median(times["tilted"])), "ratio": ratio})  # fmt: skip
        results.bar(f"time of TiltPlane over a plain fit, {side} x {side}, {dtype}", ratio, 5.0)


def _picture(maps: dict[str, Any]) -> Any:
    """The edge as each method sees it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.0 * len(maps), 3.2), layout="constrained")
    for axes, (name, image) in zip(figure.subplots(1, len(maps)), maps.items(), strict=True):
        drawn = axes.imshow(np.degrees(image), vmin=60, vmax=180, interpolation="nearest")
        axes.set_title(name)
        axes.set_xticks([])
        axes.set_yticks([])
    figure.colorbar(drawn, ax=figure.axes, label="retardance (°)", shrink=0.8)
    return figure
