"""The command ``polinfer compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import PATH, declared_model, model_options

__all__ = ["compare_command"]


@click.command("compare")
@click.argument("files", type=PATH, nargs=-1, required=True)
@model_options
@click.option("--picture", type=PATH, help="Also draw evidences and probabilities into this file (.png, .pdf, .svg).")
@click.pass_context
def compare_command(ctx: click.Context, files: tuple[Path, ...], picture: Path | None, **declared: Any) -> None:
    """Compare models of the same data by their evidence, and print which one the data speak for.

    FILES are two or more results (fits or draws), named by their file names, or one measurement, which is fitted with
    both orderings of the model that the options declare, and with the same model without diattenuation, which is what
    the orderings have in common.

    Example: polinfer compare retarder_first.nc polariser_first.nc --picture evidence.png

    Example: polinfer compare measurement.nc --gain phase
    """
    from .. import files as storage
    from ..comparison import compare, select
    from ..records import Measurement

    given = [name for name in declared if ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE]
    loaded = {path: storage.load(path) for path in files}
    if len(loaded) < len(files):
        raise click.UsageError("FILES names one file twice.")
    if len(files) == 1 and isinstance(loaded[files[0]], Measurement):
        if "ordering" in given:
            raise click.UsageError("compare fits both orderings; leave out --ordering.")
        models = {
            name: declared_model(**(declared | {"ordering": name})) for name in ("retarder_first", "polariser_first")
        }
        if "diattenuation" in models["retarder_first"].free:
            fixed = declared["fix"] + ("diattenuation=0",)
            models["no_diattenuation"] = declared_model(**(declared | {"fix": fixed}))
        found = select(models, loaded[files[0]])
    else:
        for path, result in loaded.items():
            if not (hasattr(result, "log_evidence") and hasattr(result, "model")):
                raise click.UsageError(f"{path} holds a {type(result).__name__}, no result of a fit or a sampler; pass "
                                       "two or more results, or one measurement.")  # fmt: skip
        if given:
            option = "--" + given[0].replace("_", "-")
            raise click.UsageError(f"{option} is only for a measurement: results have the models they were made with.")
        if len(files) < 2:
            raise click.UsageError("FILES must be two or more results, or one measurement.")
        found = compare(dict(zip(_names(files), loaded.values(), strict=True)))
    click.echo(found.table())
    if picture is not None:
        found.plot().savefig(picture)


def _names(files: tuple[Path, ...]) -> list[str]:
    """File names without endings, whole paths where these are alike."""
    stems = [path.stem for path in files]
    return stems if len(set(stems)) == len(stems) else [str(path) for path in files]
