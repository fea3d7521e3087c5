"""Pictures of results. Angles are shown in degrees, lengths in micrometres."""

from __future__ import annotations

from math import floor, log10, pi
from typing import TYPE_CHECKING, Any

import numpy as np

from .checks import one_of_types, real_number
from .gauge import smooth_gauge
from .records import PERIODS, Fit, Parameters, Status

if TYPE_CHECKING:
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    from .phantoms import Phantom
    from .sampling.summaries import Summary

__all__ = ["colour_circle", "draw_map", "explain", "map_grid", "plot_fit", "plot_phantom", "plot_summary"]

TITLES = Parameters(
    "diattenuation", "diattenuation angle (°)", "retardance (°)", "retardance angle (°)", "circularity (°)"
)
_NO_ANSWER = int(Status.MASKED | Status.NON_FINITE | Status.NOT_CONVERGED)
_GREY = "0.8"
# inches: width of a map, of its colour bar and the gap before it, of all that is beside a map, before the first map,
# height of a title, of a scale bar, of the line that explains what grey and hatched pixels are
MAP, BAR, BAR_GAP, BESIDE, LEFT, TITLE, SCALE_BAR, EXPLANATION = 2.1, 0.1, 0.06, 0.75, 0.1, 0.32, 0.2, 0.36
_HATCHED: dict[str, Any] = {"facecolor": "0.93", "edgecolor": "0.45", "hatch": "//////"}


def colour_circle() -> ListedColormap:
    """Colours for angles: 256 hues in even steps, the last beside the first.

    ``L = 0.71 + 0.1 cos(h - 3)``, ``C = 0.13`` in OKLCH, with the hue h once round from end to end. No grey occurs in
    it, so that grey can stand for "unknown"; the lightness helps those who see hues badly.

    Source: B. Ottosson, "A perceptual color space for image processing", 2020 (OKLab).

    >>> colours = colour_circle()
    >>> bool(np.abs(np.subtract(colours(0.0), colours(1.0))).max() < 0.03)
    True
    """
    from matplotlib.colors import ListedColormap

    hue = 2 * pi * np.arange(256) / 256 + pi + 0.5
    lightness, chroma = 0.71 + 0.1 * np.cos(hue - 3), 0.13
    a, b = chroma * np.cos(hue), chroma * np.sin(hue)
    cones = np.stack([
        lightness + 0.3963377774 * a + 0.2158037573 * b,
        lightness - 0.1055613458 * a - 0.0638541728 * b,
        lightness - 0.0894841775 * a - 1.2914855480 * b,
    ]) ** 3  # fmt: skip
    linear = np.array([
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]) @ cones  # fmt: skip
    display = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return ListedColormap(np.clip(display, 0, 1).T, name="colour_circle")


def _image(values: Any) -> np.ndarray:
    """Any pixel shape as one image, frames below each other."""
    array = np.asarray(values)
    return array.reshape(-1, array.shape[-1] if array.ndim else 1)


def _scale_bar(axes: Any, columns: int, pixel_size: float) -> None:
    """A bar below the map: 1, 2 or 5 times a power of ten, at most a third of the width, if there is one so short."""
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar  # type: ignore[import-untyped]

    limit = columns * pixel_size / 3 * 1e6
    power = 10.0 ** floor(log10(limit))
    length = next(n * power for n in (5, 2, 1) if n * power <= limit * (1 + 1e-9))
    bar = AnchoredSizeBar(
        axes.transData, length * 1e-6 / pixel_size, f"{length:g} µm", loc="upper right", pad=0.2, sep=2, frameon=False,
        bbox_to_anchor=(1.0, -0.01), bbox_transform=axes.transAxes, borderpad=0, fontproperties={"size": 7},
    )  # fmt: skip
    axes.add_artist(bar)


def draw_map(
    axes: Any,
    title: str,
    values: np.ndarray,
    lost: np.ndarray,
    period: float | None = None,
    high: float | None = None,
    unknown: np.ndarray | None = None,
    pixel_size: float | None = None,
) -> None:
    """One map with its colour bar.

    ``period`` in the unit of the values makes it a circle. ``high``: a scale from 0, at most to there, that leaves the
    largest 2 % of the values to the colour of its end. Hatched where lost, grey where unknown.
    """
    import matplotlib

    colours: Any
    grey = np.zeros(np.shape(lost), bool) if unknown is None else unknown
    image = np.ma.masked_invalid(np.where(_image(lost | grey), np.nan, _image(values)))
    shown, extend = image.compressed(), "neither"
    low, top = (float(shown.min()), float(shown.max())) if shown.size else (0.0, 1.0)
    if period is not None:
        colours, limits = colour_circle(), (-0.5 * period, 0.5 * period)
    elif high is not None:
        end = min(float(np.percentile(shown, 98)), high) if shown.size else 1.0
        colours, limits, extend = matplotlib.colormaps["viridis"], (0.0, end or 1.0), "max" if top > end else "neither"
    elif title == TITLES.diattenuation and low < 0:
        colours, limits = matplotlib.colormaps["PuOr_r"], (-max(top, -low), max(top, -low))
    else:
        colours, limits = matplotlib.colormaps["viridis"], (low, top)
    long = max(image.shape) > 6 * min(image.shape)
    axes.set_facecolor(_HATCHED["facecolor"])
    axes.patch.set(hatch=_HATCHED["hatch"], edgecolor=_HATCHED["edgecolor"], linewidth=0)
    drawn = axes.imshow(
        image, cmap=colours, interpolation="nearest", vmin=limits[0], vmax=limits[1], aspect="auto" if long else "equal"
    )
    if grey.any():
        cover = np.ma.masked_where(~_image(grey), np.zeros(image.shape))
        axes.imshow(
            cover, cmap=matplotlib.colors.ListedColormap([_GREY]), interpolation="nearest", aspect=axes.get_aspect()
        )
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    ticks = None if period is None else np.linspace(-0.5, 0.5, 5) * period
    # as high as the map is shown, and as wide as all others
    box, inches = axes.get_position(), axes.figure.get_size_inches()
    wide, tall = box.width * inches[0], box.height * inches[1]
    if not long:
        wide = min(wide, tall * image.shape[1] / image.shape[0])
    beside = axes.inset_axes((1 + BAR_GAP / wide, 0, BAR / wide, 1))
    bar = axes.figure.colorbar(drawn, cax=beside, extend=extend, ticks=ticks)
    bar.ax.tick_params(labelsize=7)
    if pixel_size is not None and not (long and image.shape[0] > image.shape[1]):
        _scale_bar(axes, image.shape[1], pixel_size)


def map_grid(
    pixels: np.ndarray, rows: int, columns: int, pixel_size: float | None, below: float = EXPLANATION,
    right: float = BESIDE,
) -> tuple[Figure, np.ndarray]:  # fmt: skip
    """A figure with rows of maps, as high as ``pixels``, one of the maps, ask for.

    Margins are fixed, with room for titles, colour bars and scale bars: to measure the text of fifteen maps takes
    longer than to draw them. ``below`` the maps there is room for :func:`explain`, and to the ``right`` of the last one
    for what stands there, in inches.
    """
    from matplotlib.figure import Figure

    high, wide = _image(pixels).shape
    height = min(max(MAP * high / wide, 0.7), 3.0)
    gap = TITLE if pixel_size is None else TITLE + SCALE_BAR
    size = (LEFT + (MAP + BESIDE) * columns - BESIDE + right, (height + gap) * rows + below)
    edges = {"left": LEFT / size[0], "right": 1 - right / size[0], "top": 1 - TITLE / size[1],
             "bottom": (below + gap - TITLE) / size[1]}  # fmt: skip
    figure = Figure(figsize=size)
    gaps = {"wspace": BESIDE / MAP, "hspace": gap / height}
    return figure, figure.subplots(rows, columns, squeeze=False, gridspec_kw=edges | gaps)


def _draw_parameters(
    axes: np.ndarray, parameters: Parameters, std: Parameters, status: np.ndarray, pixel_size: float | None
) -> bool:
    """Maps of the five parameters above their standard deviations; whether any pixel is grey."""
    lost, grey = (status & _NO_ANSWER) != 0, False
    for i, name in enumerate(Parameters._fields):
        unit = 1.0 if name == "diattenuation" else 180 / np.pi
        value, width = unit * np.asarray(getattr(parameters, name)), unit * np.asarray(getattr(std, name))
        unknown = ~lost & ((status & int(Status.unidentified(name))) != 0)
        grey = grey or bool(np.any(unknown))
        period = None if name == "diattenuation" else unit * getattr(PERIODS, name)
        draw_map(axes[0, i], getattr(TITLES, name), value, lost, period, unknown=unknown, pixel_size=pixel_size)
        # a width beyond that of a uniform distribution says no more than "unknown" and would hide all others
        ceiling = (2 if period is None else period) / 12**0.5
        title = "± standard deviation" if period is None else "± standard deviation (°)"
        dropped = ~lost & np.isnan(width)
        draw_map(axes[1, i], title, width, lost, high=ceiling, unknown=dropped, pixel_size=pixel_size)
    return grey


def _draw_tilt(axes: np.ndarray, fit: Fit, pixel_size: float | None) -> None:
    """The phase between the arms above its standard deviation, grey where it is not known; it has no holes."""
    assert fit.tilt is not None
    unknown = (np.asarray(fit.status) & int(Status.TILT_UNIDENTIFIED)) != 0
    known = np.zeros(np.shape(unknown), bool)
    phase, width = np.degrees(fit.tilt.phase), np.degrees(fit.tilt.phase_std)
    draw_map(axes[0], "tilt (°)", phase, known, unknown=unknown, pixel_size=pixel_size)
    draw_map(axes[1], "± standard deviation (°)", width, known, high=np.inf, pixel_size=pixel_size)


def explain(figure: Figure, grey: bool, hatched: bool, smooth: bool) -> None:
    """What grey and hatched pixels mean, and which gauge it is."""
    from matplotlib.patches import Patch

    handles = [Patch(facecolor=_GREY, label="not identified")] if grey else []
    handles += [Patch(**_HATCHED, linewidth=0, label="no answer")] if hatched else []
    handles += [Patch(alpha=0, label="smooth gauge")] if smooth else []
    if handles:
        figure.legend(handles=handles, loc="lower right", ncols=3, fontsize=8, frameon=False, borderpad=0.5)


def plot_fit(fit: Fit, smooth: bool = False, pixel_size: float | None = None) -> Figure:
    """Maps of a fit: each parameter above its standard deviation, beside reduced chi-square and evidence.

    Angles are in degrees, in colours that close on themselves over their period (:func:`colour_circle`); a retardance
    without a free gain has real ends, but is shown on the same circle. D has a scale with 0 in its middle where it is
    negative somewhere. A scale of standard deviations begins at 0 and ends at the 98th percentile, or at the width of
    a uniform distribution; a pointed end says that larger values have its colour. Hatched pixels have no answer
    (masked, not finite or not converged); in grey ones the parameter is not identified.

    Parameters
    ----------
    fit: of any pixel shape; a single pixel or a row is shown as an image, frames stand below each other.
    smooth: show the equivalent parameters that :func:`polinfer.smooth_gauge` chooses instead of those of the fit.
    pixel_size: side of a pixel, metres, > 0, for a scale bar below every map; None: no bar. Frames more than six times
        as long as wide are stretched, and columns have no bar.

    Raises
    ------
    TypeError, ValueError: not a fit, a pixel size out of range.

    >>> import polinfer
    >>> scene = polinfer.phantoms.lesion((4, 4), rng=1)
    >>> data = polinfer.simulate(polinfer.Model(), scene.parameters, np.eye(2), sigma=0.05, rng=1)
    >>> figure = plot_fit(polinfer.fit(polinfer.Model(), data), pixel_size=9e-6)
    >>> [axes.get_title() for axes in figure.axes][:2]
    ['χ² / degrees of freedom', 'diattenuation']
    """
    one_of_types("fit", fit, (Fit,), "pass the result of fit().")
    if pixel_size is not None:
        pixel_size = real_number("pixel_size", pixel_size, above=0)
    status = np.asarray(fit.status)
    lost = (status & _NO_ANSWER) != 0
    extra = (1 if fit.gain is None else 2) + (fit.tilt is not None)
    figure, axes = map_grid(status, 2, 5 + extra, pixel_size)
    quality = axes[1] if fit.gain is not None else axes[:, 0]
    if fit.gain is not None:
        draw_map(axes[0, 0], "amplitude", np.abs(fit.gain), lost, pixel_size=pixel_size)
        draw_map(axes[0, 1], "phase (°)", np.degrees(np.angle(fit.gain)), lost, period=360.0, pixel_size=pixel_size)
    freedom = np.asarray(fit.degrees_of_freedom)
    draw_map(quality[0], "χ² / degrees of freedom", fit.chi_square / np.maximum(freedom, 1), lost | (freedom == 0),
          high=np.inf, pixel_size=pixel_size)  # fmt: skip
    draw_map(quality[1], "log evidence (nat)", fit.log_evidence, lost, pixel_size=pixel_size)
    if fit.tilt is not None:
        _draw_tilt(axes[:, extra - 1], fit, pixel_size)
    parameters = smooth_gauge(fit.parameters, status) if smooth else fit.parameters
    grey = _draw_parameters(axes[:, extra:], parameters, fit.std, status, pixel_size)
    explain(figure, grey, bool(lost.any()), smooth)
    return figure


def plot_summary(summary: Summary, smooth: bool = False, pixel_size: float | None = None) -> Figure:
    """Maps of full posteriors: the mean of each parameter above its standard deviation, beside those of the chains.

    As :func:`plot_fit`, with mean directions and circular standard deviations. The first column is how well the chains
    agree: how far the largest split R-hat is above 1, where it would be if they did, and the smallest number of
    effective draws of the pixel.

    Parameters
    ----------
    summary: of any pixel shape. smooth, pixel_size: see :func:`plot_fit`.

    Raises
    ------
    TypeError, ValueError: not a summary, a pixel size out of range.

    >>> import polinfer
    >>> from polinfer.sampling.summaries import summarise_draws
    >>> draws = Parameters(*np.random.default_rng(0).normal(0.5, 0.1, (5, 2, 50, 3, 4)))
    >>> summary = summarise_draws(polinfer.Model(), draws, None, None, np.zeros((3, 4), int), level=0.68)
    >>> [axes.get_title() for axes in plot_summary(summary).axes][:2]
    ['largest R-hat − 1', 'diattenuation']
    """
    from .sampling.summaries import Summary

    one_of_types("summary", summary, (Summary,), "pass the result of Draws.summary().")
    if pixel_size is not None:
        pixel_size = real_number("pixel_size", pixel_size, above=0)
    status = np.asarray(summary.status)
    lost = (status & _NO_ANSWER) != 0
    figure, axes = map_grid(status, 2, 6, pixel_size)
    # how the chains fare is shown where it is bad, too
    none = np.isnan(summary.ess)
    # infinite where no chain has moved
    excess = np.minimum(summary.r_hat - 1, 10.0)
    draw_map(axes[0, 0], "largest R-hat − 1", excess, none, high=np.inf, pixel_size=pixel_size)
    draw_map(axes[1, 0], "fewest effective draws", summary.ess, none, high=np.inf, pixel_size=pixel_size)
    parameters = smooth_gauge(summary.mean, status) if smooth else summary.mean
    grey = _draw_parameters(axes[:, 1:], parameters, summary.std, status, pixel_size)
    explain(figure, grey, bool(lost.any()), smooth)
    return figure


def plot_phantom(phantom: Phantom, pixel_size: float | None = None) -> Figure:
    """Maps of what is true in a phantom: amplitude, phase, the five parameters, tilt if there is one, regions.

    A row for each frame of a series. Angles are in degrees, in colours that close on themselves.

    Parameters
    ----------
    phantom: of shape (y, x) or (frame, y, x). pixel_size: side of a pixel, metres, > 0, for a scale bar below every
        map; None: no bar.

    Raises
    ------
    TypeError, ValueError: not a phantom, another shape, a pixel size out of range.

    >>> import polinfer
    >>> figure = plot_phantom(polinfer.phantoms.half_wave_plate((6, 6), [0.0, 0.3]), pixel_size=9e-6)
    >>> [axes.get_title() for axes in figure.axes][:3]
    ['amplitude', 'phase (°)', 'diattenuation']
    """
    from .phantoms import Phantom

    one_of_types("phantom", phantom, (Phantom,), "pass one of polinfer.phantoms.")
    if phantom.labels.ndim not in (2, 3):
        raise ValueError(f"phantom must have shape (y, x) or (frame, y, x) to be drawn, got {phantom.labels.shape}.")
    if pixel_size is not None:
        pixel_size = real_number("pixel_size", pixel_size, above=0)
    frames = [phantom] if phantom.labels.ndim == 2 else [phantom[i] for i in range(len(phantom))]
    several = int(phantom.labels.max(initial=0)) > 0
    columns = 7 + (phantom.tilt is not None) + several
    labels = frames[0].labels
    right = max(BESIDE, 0.5 + 0.08 * max(map(len, phantom.names), default=0)) if several else BESIDE
    figure, grid = map_grid(labels, len(frames), columns, pixel_size, below=0.1, right=right)
    for row, frame in zip(grid, frames, strict=True):
        maps: list[tuple[str, Any, float | None]] = [
            ("amplitude", np.abs(frame.gain), None),
            ("phase (°)", np.degrees(np.angle(frame.gain)), 360.0),
        ]
        for name, value in zip(Parameters._fields, frame.parameters, strict=True):
            unit, period = (1.0, None) if name == "diattenuation" else (180 / pi, 180 / pi * getattr(PERIODS, name))
            maps.append((getattr(TITLES, name), unit * value, period))
        if frame.tilt is not None:
            maps.append(("tilt (°)", np.degrees(np.angle(np.exp(1j * frame.tilt))), 360.0))
        for axes, (title, value, period) in zip(row, maps, strict=False):
            draw_map(axes, title, value, np.zeros(labels.shape, bool), period, pixel_size=pixel_size)
        if several:
            _draw_regions(row[-1], frame.labels, int(phantom.labels.max()), phantom.names, pixel_size)
    return figure


def _draw_regions(axes: Any, labels: np.ndarray, top: int, names: tuple[str, ...], pixel_size: float | None) -> None:
    """Map of labels, one colour for each, with its legend."""
    import matplotlib
    from matplotlib.patches import Patch

    colours = matplotlib.colors.ListedColormap([matplotlib.colormaps["tab20"](k % 20) for k in range(top + 1)])
    axes.imshow(labels, cmap=colours, vmin=-0.5, vmax=top + 0.5, interpolation="nearest")
    axes.set_title("regions", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    called = names or tuple(str(k) for k in range(top + 1))
    axes.legend(
        handles=[Patch(color=colours(k), label=called[k]) for k in range(top + 1)], loc="upper left",
        bbox_to_anchor=(1.0, 1.0), fontsize=7, frameon=False,
    )  # fmt: skip
    if pixel_size is not None:
        _scale_bar(axes, labels.shape[1], pixel_size)
