"""The command ``polinfer fit``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import PATH, declared_model, measurement_of, model_options, overwrite_option, vacant

__all__ = ["fit_command"]


def _middle(values: Any, period: float) -> tuple[str, float]:
    """What kind of middle, and the middle of the values that are known: one that has no trouble with the wrap."""
    import numpy as np

    if np.isinf(period):
        return "median", float(np.nanmedian(values))
    turn = period / (2 * np.pi)
    return "circular mean", float(turn * np.angle(np.nanmean(np.exp(1j * np.asarray(values, float) / turn))))


def _tell_tilt(tilt: Any) -> None:
    """Piston and slopes of the first frames, degrees."""
    import numpy as np

    terms = tilt.coefficients.shape[-1]
    frames = zip(
        np.degrees(tilt.coefficients).reshape(-1, terms),
        np.degrees(np.sqrt(np.diagonal(tilt.covariance, axis1=-2, axis2=-1))).reshape(-1, terms),
        tilt.probability.reshape(-1),
        strict=True,
    )
    for number, (value, width, probability) in enumerate(frames):
        if number == 3:
            click.echo(f"  tilt: and {tilt.probability.size - 3} frames more")
            break
        pairs = zip(("piston", "rows", "columns"), value, width, strict=False)
        told = ", ".join(f"{name} {x:.4g} ± {s:.2g}" for name, x, s in pairs)
        click.echo(f"  tilt: {told} degrees from edge to edge, probability {probability:.3g}")


@click.command("fit")
@click.argument("measurement", type=PATH)
@click.argument("out", type=PATH)
@model_options
@click.option("--picture", type=PATH, help="Also draw the maps into this file (.png, .pdf, .svg).")
@click.option(
    "--smooth-gauge/--reference-gauge",
    "smooth",
    default=None,
    show_default="reference",
    help="Which of the equivalent parameters the picture shows: smooth maps, or what OUT holds.",
)
@click.option("--pixel-size", type=float, help="Side of a pixel in micrometres, for a scale bar in the picture.")
@click.option(
    "--pixels-at-a-time",
    type=click.IntRange(min=1),
    help="Fit so many pixels after the other from disk, for frames larger than memory: both files end in .zarr. The "
    "same command goes on where it was interrupted.",
)
@overwrite_option
@click.option("--progress/--no-progress", default=True, show_default=True, help="Show a progress bar.")
def fit_command(
    measurement: Path,
    out: Path,
    picture: Path | None,
    smooth: bool | None,
    pixel_size: float | None,
    pixels_at_a_time: int | None,
    overwrite: bool,
    progress: bool,
    **declared: Any,
) -> None:
    """Fit the five parameters of every pixel of MEASUREMENT and write the result to OUT (.nc or .zarr).

    Example: polinfer fit measurement.nc result.nc --gain complex --gain-scale 1.0 --picture map.png

    Example: polinfer fit measurement.nc result.nc --window 3 5 --fix diattenuation=0

    Example: polinfer fit measurement.nc result.nc --tilt plane

    Example: polinfer fit huge.zarr result.zarr --pixels-at-a-time 1000000
    """
    import numpy as np

    from .. import storage
    from ..chunked import fit_stored
    from ..fitting import fit
    from ..records import PERIODS, Parameters, Status

    if picture is None and (smooth is not None or pixel_size is not None):
        raise click.UsageError("the gauge and --pixel-size are only for --picture.")
    model = declared_model(**declared)
    vacant(out, overwrite)
    if pixels_at_a_time is not None:
        if picture is not None or overwrite:
            raise click.UsageError("--pixels-at-a-time draws no picture and replaces nothing.")
        try:
            click.echo(f"wrote {fit_stored(model, measurement, out, pixels_at_a_time, progress=progress)}")
        except (ValueError, FileNotFoundError) as error:
            raise click.UsageError(str(error)) from error
        return
    data = measurement_of(measurement, declared)
    result = fit(model, data, progress=progress)
    storage.save(result, out, overwrite=overwrite)
    if picture is not None:
        size = None if pixel_size is None else pixel_size * 1e-6
        result.plot(smooth=bool(smooth), pixel_size=size).savefig(picture)
    click.echo(f"{result.status.size} pixels, {int(np.sum(result.status == 0))} OK")
    for flag in Status:
        count = int(np.sum((result.status & int(flag)) != 0))
        if count:
            click.echo(f"  {flag.name}: {count}")
    for name in Parameters._fields:
        values, widths = getattr(result.parameters, name), getattr(result.std, name)
        if np.isfinite(widths).any():
            scale, unit = (1.0, "") if name == "diattenuation" else (180 / np.pi, " degrees")
            period = float("inf") if name in model.bounds else getattr(PERIODS, name)
            kind, middle = _middle(values, period)
            width = scale * float(np.nanmedian(widths))
            click.echo(f"  {name}: {kind} {scale * middle:.4g}, median standard deviation {width:.2g}{unit}")
    if result.tilt is not None:
        _tell_tilt(result.tilt)
    if declared["infer_noise"] is not None and np.isfinite(result.sigma).any():
        click.echo(f"  sigma: median {float(np.nanmedian(result.sigma)):.4g}")
