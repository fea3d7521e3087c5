"""The command ``polinfer sample``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import PATH, declared_model, measurement_of, model_options, overwrite_option, vacant

__all__ = ["sample_command"]


@click.command("sample")
@click.argument("measurement", type=PATH)
@click.argument("out", type=PATH)
@model_options
@click.option(
    "--sampler",
    type=click.Choice(["gibbs", "ensemble"]),
    default="gibbs",
    show_default=True,
    help="gibbs: all pixels at once; ensemble: emcee, one pixel after the other.",
)
@click.option("--chains", type=click.IntRange(min=1), default=4, show_default=True, help="Independent chains.")
@click.option("--draws", type=click.IntRange(min=4), default=1000, show_default=True, help="Draws kept of each chain.")
@click.option("--seed", type=click.IntRange(min=0), show_default="drawn, and printed", help="Seed.")
@click.option("--picture", type=PATH, help="Also draw maps of means and widths into this file (.png, .pdf, .svg).")
@overwrite_option
@click.option("--progress/--no-progress", default=True, show_default=True, help="Show a progress bar.")
def sample_command(
    measurement: Path,
    out: Path,
    sampler: str,
    chains: int,
    draws: int,
    seed: int | None,
    picture: Path | None,
    overwrite: bool,
    progress: bool,
    **declared: Any,
) -> None:
    """Draw from the posterior of every pixel of MEASUREMENT and write the draws to OUT (.nc or .zarr).

    Example: polinfer sample measurement.nc draws.nc --draws 500 --seed 1 --picture posterior.png
    """
    import numpy as np

    from .. import storage
    from ..records import Parameters, Status
    from ..sampling import Ensemble, Gibbs, sample

    model = declared_model(**declared)
    vacant(out, overwrite)
    data = measurement_of(measurement, declared)
    chosen = Gibbs() if sampler == "gibbs" else Ensemble()
    found = sample(model, data, chosen, chains=chains, draws=draws, rng=seed, progress=progress)
    storage.save(found, out, overwrite=overwrite)
    summary = found.summary()
    if picture is not None:
        summary.plot().savefig(picture)
    click.echo(f"seed {found.seed}; {chains} chains of {draws} draws; {summary.status.size} pixels")
    for flag in Status:
        count = int(np.sum((summary.status & int(flag)) != 0))
        if count:
            click.echo(f"  {flag.name}: {count}")
    for name in Parameters._fields:
        widths = np.asarray(getattr(summary.std, name))
        if np.isfinite(widths).any():
            scale, unit = (1.0, "") if name == "diattenuation" else (180 / np.pi, " degrees")
            click.echo(f"  {name}: median posterior width {scale * float(np.nanmedian(widths)):.2g}{unit}")
    if np.isfinite(found.log_evidence).any():
        error = float(np.nanmax(found.log_evidence_error))
        click.echo(
            f"  log evidence: sum {float(np.nansum(found.log_evidence)):.2f}, worst error of a pixel {error:.2g}"
        )
