"""The command line ``polinfer``; packages above add commands by entry points of the group ``polinfer.commands``."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import Any

import click

__all__ = ["fit_command", "main"]

GROUP = "polinfer.commands"


class _UserError(click.ClickException):
    exit_code = 2


class _Commands(click.Group):
    """Commands by entry point, imported when they are used; mistakes of the user end in one line, not a traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        return sorted(metadata.entry_points(group=GROUP).names)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        found = [entry for entry in metadata.entry_points(group=GROUP) if entry.name == cmd_name]
        return found[0].load() if found else None

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (ValueError, TypeError, OSError) as error:
            message = " ".join(str(error).split()) or type(error).__name__
            raise _UserError(message) from error


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="polinfer", prog_name="polinfer")
def main() -> None:
    """Polarisation parameters from measured fields, with their uncertainty.

    Example: polinfer fit measurement.nc result.nc --gain phase --picture map.png
    """
    import jax

    # a program decides about precision; the library never does
    jax.config.update("jax_enable_x64", True)


@click.command("fit")
@click.argument("measurement", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--ordering",
    type=click.Choice(["retarder_first", "polariser_first"]),
    default="retarder_first",
    show_default=True,
    help="Which element the light meets first.",
)
@click.option(
    "--gain",
    type=click.Choice(["none", "phase", "complex"]),
    default="none",
    show_default=True,
    help="Unknown complex factor of every pixel.",
)
@click.option("--gain-scale", type=float, help="Root mean square amplitude of a complex gain; needed with it.")
@click.option(
    "--picture", type=click.Path(path_type=Path), help="Also draw the maps into this file (.png, .pdf, .svg)."
)
@click.option("--overwrite", is_flag=True, help="Replace OUT if it exists.")
@click.option("--progress/--no-progress", default=True, show_default=True, help="Show a progress bar.")
def fit_command(
    measurement: Path,
    out: Path,
    ordering: str,
    gain: str,
    gain_scale: float | None,
    picture: Path | None,
    overwrite: bool,
    progress: bool,
) -> None:
    """Fit the five parameters of every pixel of MEASUREMENT and write the result to OUT (.nc or .zarr).

    Example: polinfer fit measurement.nc result.nc --gain complex --gain-scale 1.0 --picture map.png
    """
    import numpy as np

    from . import files, storage
    from .fitting import fit
    from .gain import ComplexGain, Gain, PhaseGain
    from .model import Model
    from .orderings import PolariserFirst, RetarderFirst
    from .records import Measurement, Parameters, Status

    chosen: Gain | None = None
    if gain == "complex":
        if gain_scale is None:
            raise click.UsageError("--gain complex needs --gain-scale: the root mean square amplitude of the gain.")
        chosen = ComplexGain(gain_scale)
    elif gain_scale is not None:
        raise click.UsageError("--gain-scale is only for --gain complex.")
    elif gain == "phase":
        chosen = PhaseGain()
    if out.exists() and not overwrite:
        raise click.UsageError(f"{out} exists; choose another name or pass --overwrite.")
    data = files.load(measurement)
    if not isinstance(data, Measurement):
        raise click.UsageError(f"{measurement} holds a {type(data).__name__}, not a Measurement.")
    model = Model(RetarderFirst() if ordering == "retarder_first" else PolariserFirst(), gain=chosen)
    result = fit(model, data, progress=progress)
    storage.save(result, out, overwrite=overwrite)
    if picture is not None:
        result.plot().savefig(picture)
    click.echo(f"{result.status.size} pixels, {int(np.sum(result.status == 0))} OK")
    for flag in Status:
        count = int(np.sum((result.status & int(flag)) != 0))
        if count:
            click.echo(f"  {flag.name}: {count}")
    for name in Parameters._fields:
        values, widths = getattr(result.parameters, name), getattr(result.std, name)
        if np.isfinite(widths).any():
            scale, unit = (1.0, "") if name == "diattenuation" else (180 / np.pi, " degrees")
            middle, width = (scale * float(np.nanmedian(x)) for x in (values, widths))
            click.echo(f"  {name}: median {middle:.4g}, median standard deviation {width:.2g}{unit}")
