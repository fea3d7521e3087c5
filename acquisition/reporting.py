"""One page that can be sent to somebody: maps with their uncertainty, what the data do not tell, and the verdict.

In: a folder with the records of a sample (``measurement.nc``, ``fit.nc``). Out: a self-contained HTML page, pictures
inside. Called by the demo and by ``polinfer report``.
"""

from __future__ import annotations

import base64
import hashlib
import io
import platform
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np

import polinfer
from fibre import load, transmission_image
from polinfer import Fit, Measurement, Model, Parameters, PolariserFirst, RetarderFirst, Status, contrast, texture
from polinfer.checks import integer, one_of_types

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["write_report"]

RESOLUTION = 110
FLAGS = {
    Status.MASKED: "excluded by a mask: no answer",
    Status.NON_FINITE: "the data are not finite: no answer",
    Status.NOT_CONVERGED: "the optimiser stopped early: no answer",
    Status.BAD_FIT: "neither the model nor the stated noise explains the data",
    Status.AT_EDGE: "the maximum lies on a bound: its width is a poor description",
    Status.TILT_UNIDENTIFIED: "the tilt between the arms cannot be told",
}


@dataclass
class _Section:
    title: str
    texts: list[str] = field(default_factory=list)
    pictures: list[dict[str, str]] = field(default_factory=list)
    tables: list[dict[str, Any]] = field(default_factory=list)
    text: str = ""
    verdict: bool = False

    @property
    def anchor(self) -> str:
        return "".join(c if c.isalnum() else "-" for c in self.title.lower())

    def picture(self, figure: Figure, caption: str) -> None:
        buffer = io.BytesIO()
        figure.savefig(buffer, dpi=RESOLUTION)
        width, _ = figure.get_size_inches()
        # on a phone a picture of many maps is scrolled, not shrunk until nothing is seen
        least = int(45 * width) if width > 7 else 0
        data = base64.b64encode(buffer.getvalue()).decode()
        self.pictures.append({"data": data, "caption": caption, "least": str(least)})


def write_report(
    folder: str | Path,
    out: str | Path | None = None,
    title: str = "Polarisation of a sample",
    seconds: dict[str, float] | None = None,
    draws: int = 500,
    simulations: int = 40,
    pixel_size: float | None = None,
    rng: int = 0,
    notes: tuple[str, ...] = (),
    labels: Any = None,
) -> Path:
    """Write ``report.html`` into a folder that holds ``measurement.nc`` and ``fit.nc``; the path.

    The page needs no network. It has the maps of the fit with their standard deviations, amplitude and phase, how many
    pixels have which flag, the posterior of three pixels by sampling, the tilt if the model has one, the comparison of
    the orderings with the power to tell them apart, texture, timings and provenance.

    Parameters
    ----------
    folder: with the records. out: the page; None: ``report.html`` in the folder. title: of the page. seconds: by
    stage, for the table of timings. draws: of each chain for the posteriors of pixels. simulations: of scenes for the
    power; 0: no power is stated. pixel_size: metres between pixels, for scale bars. rng: seed of draws and
    simulations. notes: sentences at the top, for instance how far a demo ended from its truth. labels: integers, the
    pixels' shape: 0 and 1 are two regions, such as tissue and lesion, whose contrast is stated; None: no contrast.

    Raises FileNotFoundError where a record is missing, ValueError for records of other kinds.
    """
    folder = Path(folder)
    simulations, draws = integer("simulations", simulations, low=0), integer("draws", draws, low=4)
    measurement, fitted = _record(folder, "measurement.nc", Measurement), _record(folder, "fit.nc", Fit)
    if labels is not None:  # before minutes of draws
        labels = np.broadcast_to(np.asarray(labels), np.shape(fitted.status))
        if not {0, 1} <= set(np.unique(labels).tolist()):
            raise ValueError(f"labels must hold the regions 0 and 1, got {np.unique(labels).tolist()[:9]}.")
    sections = [
        _summary(fitted, notes),
        *_maps(fitted, measurement, pixel_size),
        _flags(fitted),
        _pixels(fitted, measurement, draws, rng),
        *_tilt(fitted),
        _orderings(fitted, measurement, simulations, rng),
        *_texture(fitted, pixel_size),
        *_contrast(fitted, labels, rng),
        *_timings(seconds),
        _provenance(folder, fitted),
    ]
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    page = environment.from_string(resources.files("acquisition").joinpath("report.html").read_text("utf-8"))
    shape = " × ".join(map(str, np.shape(fitted.status)))
    subtitle = f"{shape} pixels, {measurement.states} states, {datetime.now(UTC):%d %B %Y, %H:%M} UTC"
    path = folder / "report.html" if out is None else Path(out)
    path.write_text(page.render(title=title, subtitle=subtitle, sections=sections), "utf-8")
    return path


def _record(folder: Path, name: str, kind: type) -> Any:
    record = load(folder / name)
    one_of_types(name, record, (kind,), "point to the folder of a demo or of your own run.")
    return record


def _known(fitted: Fit) -> np.ndarray:
    lost = int(Status.MASKED | Status.NON_FINITE | Status.NOT_CONVERGED)
    return (np.asarray(fitted.status) & lost) == 0


def _summary(fitted: Fit, notes: tuple[str, ...]) -> _Section:
    section = _Section("Summary", [*notes])
    rows = []
    known = _known(fitted)
    for name in Parameters._fields:
        values, widths = (np.asarray(getattr(p, name)) for p in (fitted.parameters, fitted.std))
        told = known & ((np.asarray(fitted.status) & int(Status.unidentified(name))) == 0) & np.isfinite(widths)
        unit = 1.0 if name == "diattenuation" else 180 / np.pi
        if not told.any():
            rows.append([name.replace("_", " "), "not identified", "", 0.0])
            continue
        middle = _centre(values[told], name)
        rows.append([name.replace("_", " ") + ("" if unit == 1 else " (°)"), float(middle * unit),
                     float(np.median(widths[told]) * unit), float(100 * told.sum() / max(known.sum(), 1))])  # fmt: skip
    head = ["parameter", "typical value", "typical standard deviation", "% of pixels that tell it"]
    section.tables.append({"head": head, "rows": rows})
    return section


def _centre(values: np.ndarray, name: str) -> float:
    """Median of D, mean direction of angles."""
    if name == "diattenuation":
        return float(np.median(values))
    turns = 2 if name.endswith("angle") else 1
    return float(np.angle(np.exp(1j * turns * values).mean()) / turns)


def _maps(fitted: Fit, measurement: Measurement, pixel_size: float | None) -> list[_Section]:
    maps = _Section("Maps")
    caption = (
        "The most probable parameters above their standard deviations. Grey: the data do not tell. Hatched: no answer."
    )
    maps.picture(fitted.plot(pixel_size=pixel_size), caption)
    image = _Section("Amplitude and phase")
    image.picture(transmission_image(measurement).plot(pixel_size), "Transmission, averaged over the states of light.")
    return [maps, image]


def _flags(fitted: Fit) -> _Section:
    section = _Section("What the data do not tell")
    status = np.asarray(fitted.status)
    rows: list[list[Any]] = []
    for flag in Status:
        count = int(np.count_nonzero(status & int(flag)))
        if flag and count:
            name = str(flag.name).removeprefix("UNIDENTIFIED_").lower().replace("_", " ")
            rows.append([FLAGS.get(flag, f"{name} is hardly constrained"), count, 100 * count / status.size])
    rows.append(
        ["nothing to remark", int(np.count_nonzero(status == 0)), 100 * np.count_nonzero(status == 0) / status.size]
    )
    section.tables.append({"head": ["", "pixels", "%"], "rows": rows})
    return section


def _pixels(fitted: Fit, measurement: Measurement, draws: int, rng: int) -> _Section:
    """Pixels of low, middle and high uncertainty of J: its evidence orders them."""
    section = _Section("Posterior of three pixels")
    known = np.argwhere(_known(fitted) & np.isfinite(np.asarray(fitted.std.retardance)))
    if len(known) == 0 or fitted.model.neighbours is not None or fitted.model.misalignment is not None:
        section.texts.append("Not shown: no pixel with an answer, or a model whose pixels are not independent.")
        return section
    order = known[np.argsort([float(np.asarray(fitted.std.retardance)[tuple(p)]) for p in known])]
    chosen = [tuple(int(i) for i in order[int(share * (len(order) - 1))]) for share in (0.1, 0.5, 0.9)]
    few = _some(measurement, chosen)
    found = polinfer.sample(fitted.model, few, polinfer.Gibbs(), chains=4, draws=draws, rng=rng)
    for number, pixel in enumerate(chosen):
        section.picture(found.plot(pixel=(number,)), f"Pixel {pixel}: draws of every pair of parameters.")
    section.texts.append(
        "Determined well, middling and badly: the tenth, half and nine tenths of the retardance's widths."
    )
    return section


def _some(measurement: Measurement, pixels: list[tuple[int, ...]]) -> Measurement:
    shape = measurement.shape
    index = tuple(np.array(axis) for axis in zip(*pixels, strict=True))

    def of(values: Any, trailing: int) -> Any:
        if values is None:
            return None
        values = np.asarray(values)
        whole = np.broadcast_to(values, (*shape, *values.shape[values.ndim - trailing :]))
        return whole[index]

    return Measurement(of(measurement.illumination, 2), of(measurement.response, 2), of(measurement.sigma, 0),
                       of(measurement.weight, 1), of(measurement.mask, 0))  # fmt: skip


def _tilt(fitted: Fit) -> list[_Section]:
    if fitted.tilt is None:
        return []
    values, covariance = np.asarray(fitted.tilt.coefficients), np.asarray(fitted.tilt.covariance)
    terms = values.shape[-1]
    first, spread = values.reshape(-1, terms)[0], np.sqrt(np.diag(covariance.reshape(-1, terms, terms)[0]))
    names = ["phase at the middle", "along rows, from edge to edge", "along columns, from edge to edge"]
    rows = [[f"{n} (rad)", float(v), float(d)] for n, v, d in zip(names, first, spread, strict=False)]
    return [_Section("Tilt between the arms", tables=[{"head": ["", "found", "standard deviation"], "rows": rows}])]


def _orderings(fitted: Fit, measurement: Measurement, simulations: int, rng: int) -> _Section:
    section = _Section("Retarder first or polariser first?", verdict=True)
    model = fitted.model
    if not isinstance(model.ordering, RetarderFirst | PolariserFirst):
        section.texts.append("Not asked: the model has an ordering of its own.")
        return section
    other = replace(model, ordering=PolariserFirst() if isinstance(model.ordering, RetarderFirst) else RetarderFirst())
    names = [_name(model), _name(other)]
    comparison = polinfer.compare({names[0]: fitted, names[1]: polinfer.fit(other, measurement)})
    section.texts.append(f"Verdict of the whole frame: {comparison.verdict}.")
    section.texts.append(_power(fitted, measurement, {names[0]: model, names[1]: other}, simulations, rng))
    section.text = comparison.table()
    section.picture(comparison.plot(), "Evidence of the frame, and the probability of each ordering, pixel by pixel.")
    return section


def _name(model: Model) -> str:
    return "retarder first" if isinstance(model.ordering, RetarderFirst) else "polariser first"


def _power(fitted: Fit, measurement: Measurement, models: dict[str, Model], simulations: int, rng: int) -> str:
    known = _known(fitted) & np.isfinite(np.asarray(fitted.std.retardance))
    plain = {n: replace(m, neighbours=None, misalignment=None) for n, m in models.items()}
    if simulations == 0 or not known.any():
        return "How often such a scene would tell its ordering was not simulated."
    parameters = Parameters(*(np.asarray(p)[known] for p in fitted.parameters))
    light = np.asarray(measurement.illumination)
    light = np.broadcast_to(light, (*measurement.shape, *light.shape[-2:]))[known].mean(0)
    sigma = float(np.median(np.broadcast_to(np.asarray(fitted.sigma), known.shape)[known]))
    names = list(models)
    found = polinfer.power(
        plain[names[0]], plain[names[1]], light, sigma, int(known.sum()), parameters, simulations, rng
    )
    return (
        f"Of {simulations} simulated scenes with these parameters, light and noise, made by {names[0]}, "
        f"{100 * found.right:.0f} % gave the right verdict, {100 * found.wrong:.0f} % the wrong one, and "
        f"{100 * found.undecided:.0f} % none."
    )


def _texture(fitted: Fit, pixel_size: float | None) -> list[_Section]:
    shape = np.shape(fitted.status)
    if len(shape) != 2 or min(shape) < 5:
        return []
    size = min(15, min(shape) // 2 * 2 - 1)
    text = f"Mean and entropy in a sliding window of {size} × {size} pixels, the noise of the fit taken out."
    section = _Section("Texture", [text])
    section.picture(
        texture.of_fit(fitted, size=size).plot(pixel_size), "Expectation above differential entropy (nats)."
    )
    return [section]


def _contrast(fitted: Fit, labels: np.ndarray | None, rng: int) -> list[_Section]:
    """Of regions 0 and 1, parameter by parameter; groups of pixels are drawn again, as neighbours are alike."""
    if labels is None:
        return []
    groups = contrast.tiles(labels.shape, max(2, min(labels.shape[-2:]) // 4))
    rows: list[list[Any]] = []
    for name in Parameters._fields:
        told = _known(fitted) & ((np.asarray(fitted.status) & int(Status.unidentified(name))) == 0)
        values = np.where(told, np.asarray(getattr(fitted.parameters, name)), np.nan)
        period = None if name == "diattenuation" else (np.pi if name.endswith("angle") else 2 * np.pi)
        if min(np.count_nonzero(told & (labels == k)) for k in (0, 1)) < 10:
            rows.append([name.replace("_", " "), "too few pixels tell it", "", "", ""])
            continue
        found = [f(values, labels, samples=groups, period=period, rng=rng) for f in (contrast.cnr, contrast.gcnr)]
        rows.append([name.replace("_", " "), *(cell for c in found for cell in (float(c.value), _interval(c)))])
    text = (
        "Regions 0 and 1. CNR: difference of means over the root of both variances; gCNR: 1 less the overlap of both "
        "distributions. Intervals of 95 %, square groups of pixels drawn again."
    )
    head = ["parameter", "CNR", "interval", "gCNR", "interval"]
    return [_Section("Contrast", [text], tables=[{"head": head, "rows": rows}])]


def _interval(found: Any) -> str:
    return f"{found.low:.2f} to {found.high:.2f}" if np.isfinite(found.low + found.high) else "too few groups"


def _timings(seconds: dict[str, float] | None) -> list[_Section]:
    if not seconds:
        return []
    rows: list[list[Any]] = [[stage, float(value)] for stage, value in seconds.items()]
    rows.append(["together", float(sum(seconds.values()))])
    return [_Section("Timings", tables=[{"head": ["stage", "seconds"], "rows": rows}])]


def _provenance(folder: Path, fitted: Fit) -> _Section:
    rows: list[list[Any]] = [[name, metadata.version(name)] for name in ("polinfer", "numpy", "scipy", "jax")]
    rows += [["Python", platform.python_version()], ["machine", f"{platform.system()} {platform.machine()}"],
             ["model", repr(fitted.model)]]  # fmt: skip
    for path in sorted(folder.glob("*.nc")):
        rows.append([path.name, "SHA-256 " + hashlib.sha256(path.read_bytes()).hexdigest()])
    return _Section("Provenance", tables=[{"head": ["", ""], "rows": rows}])
