"""The command ``polinfer texture``."""

from __future__ import annotations

from pathlib import Path

import click

from .options import PATH, overwrite_option, vacant

__all__ = ["texture_command"]


@click.command("texture")
@click.argument("result", type=PATH)
@click.argument("out", type=PATH)
@click.option("--size", type=int, default=15, show_default=True, help="Side of the window in pixels, odd.")
@click.option("--fewest", type=int, default=5, show_default=True, help="Least number of pixels for an answer.")
@click.option(
    "--subtract-noise/--with-noise",
    "subtract",
    default=True,
    show_default=True,
    help="Take the widths of the posteriors out of the entropies, so that noise is not read as disorder.",
)
@click.option(
    "--smooth-gauge/--reference-gauge",
    "smooth",
    default=False,
    show_default="reference",
    help="Which of the equivalent parameters: smooth maps, or those that RESULT holds.",
)
@click.option("--picture", type=PATH, help="Also draw the maps into this file (.png, .pdf, .svg).")
@click.option("--pixel-size", type=float, help="Side of a pixel in micrometres, for a scale bar in the picture.")
@overwrite_option
def texture_command(
    result: Path,
    out: Path,
    size: int,
    fewest: int,
    subtract: bool,
    smooth: bool,
    picture: Path | None,
    pixel_size: float | None,
    overwrite: bool,
) -> None:
    """Expectation and entropy of the parameters of a fit in a sliding window, written to OUT (.nc or .zarr).

    RESULT is what `polinfer fit` wrote.

    Example: polinfer texture result.nc texture.nc --size 15 --picture texture.png --pixel-size 9
    """
    import numpy as np

    from .. import files, storage
    from ..records import Fit
    from ..texture import of_fit

    if picture is None and pixel_size is not None:
        raise click.UsageError("--pixel-size is only for --picture.")
    vacant(out, overwrite)
    fit = files.load(result)
    if not isinstance(fit, Fit):
        raise click.UsageError(f"{result} holds a {type(fit).__name__}, not a Fit; run polinfer fit first.")
    found = of_fit(fit, size, subtract, smooth, fewest)
    storage.save(found, out, overwrite=overwrite)
    if picture is not None:
        found.plot(None if pixel_size is None else pixel_size * 1e-6).savefig(picture)
    kind = "entropy without noise" if subtract else "entropy with noise"
    for name, texture in found.maps.items():
        entropy = texture.entropy[~np.isnan(texture.entropy)]
        middle = f"median {kind if texture.noise_entropy is not None or not subtract else 'entropy with noise'}"
        value = f"{float(np.median(entropy)):.3g} nat" if entropy.size else "no window with enough pixels"
        click.echo(f"  {name}: {middle} {value}")
