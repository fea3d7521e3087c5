"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ..model import Model
    from ..orderings import Ordering

__all__ = ["PATH", "declared_model", "model_options", "named_ordering", "ordering_option", "overwrite_option", "vacant"]

PATH = click.Path(path_type=Path)

ordering_option = click.option(
    "--ordering",
    type=click.Choice(["retarder_first", "polariser_first"]),
    default="retarder_first",
    show_default=True,
    help="Which element the light meets first.",
)
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that exist.")

_MODEL = (
    ordering_option,
    click.option(
        "--gain",
        type=click.Choice(["none", "phase", "complex"]),
        default="none",
        show_default=True,
        help="Unknown complex factor of every pixel.",
    ),
    click.option("--gain-scale", type=float, help="Root mean square amplitude of a complex gain; needed with it."),
)


def model_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options from which :func:`declared_model` makes a model."""
    for option in reversed(_MODEL):
        command = option(command)
    return command


def named_ordering(name: str) -> Ordering:
    """The ordering that ``--ordering`` names."""
    from ..orderings import PolariserFirst, RetarderFirst

    return RetarderFirst() if name == "retarder_first" else PolariserFirst()


def declared_model(ordering: str, gain: str, gain_scale: float | None) -> Model:
    """The model that the options of :func:`model_options` declare."""
    from ..gain import ComplexGain, Gain, PhaseGain
    from ..model import Model

    chosen: Gain | None = None
    if gain == "complex":
        if gain_scale is None:
            raise click.UsageError("--gain complex needs --gain-scale: the root mean square amplitude of the gain.")
        chosen = ComplexGain(gain_scale)
    elif gain_scale is not None:
        raise click.UsageError("--gain-scale is only for --gain complex.")
    elif gain == "phase":
        chosen = PhaseGain()
    return Model(named_ordering(ordering), gain=chosen)


def vacant(path: Path, overwrite: bool) -> None:
    """Refuse to write over a file before the work is done, not after it."""
    if path.exists() and not overwrite:
        raise click.UsageError(f"{path} exists; choose another name or pass --overwrite.")
