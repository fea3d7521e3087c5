"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ..model import Model
    from ..orderings import Ordering
    from ..records import Measurement

__all__ = [
    "PATH",
    "declared_model",
    "measurement_of",
    "model_options",
    "named_ordering",
    "ordering_option",
    "overwrite_option",
    "vacant",
]

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
    click.option(
        "--window",
        nargs=2,
        type=int,
        metavar="ROWS COLUMNS",
        help="The pixels of such a window share their parameters; odd numbers.",
    ),
    click.option(
        "--tilt",
        type=click.Choice(["none", "plane", "rotated-basis"]),
        default="none",
        show_default=True,
        help="The two arms are out of line: a phase plane over the frame, or the published model (needs --window).",
    ),
    click.option(
        "--tilt-scale",
        type=float,
        help="Standard deviation of the plane's slopes before the data, degrees from edge to edge.  [default: 1146]",
    ),
    click.option(
        "--infer-noise",
        type=click.Choice(["pixel", "frame"]),
        help="The noise is unknown, one sigma a pixel or a frame; a sigma in the file is not used.",
    ),
    click.option(
        "--noise-shape", type=float, help="Inverse gamma prior of sigma^2: shape, half the real data it is worth."
    ),
    click.option("--noise-scale", type=float, help="Inverse gamma prior of sigma^2: scale, about shape times sigma^2."),
    click.option(
        "--fix",
        multiple=True,
        metavar="NAME=VALUE",
        help="A known parameter, such as diattenuation=0 or retardance_angle=30 (degrees). Repeatable.",
    ),
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


def _known_values(fix: tuple[str, ...]) -> dict[str, float]:
    """Values by name, angles in radians."""
    from math import degrees, radians

    from ..records import RANGES, Parameters

    known: dict[str, float] = {}
    for text in fix:
        name, _, number = text.partition("=")
        if name not in Parameters._fields:
            raise click.UsageError(f"--fix {text}: the parameters are {', '.join(Parameters._fields)}.")
        if name in known:
            raise click.UsageError(f"--fix names {name} twice.")
        try:
            value = float(number)
        except ValueError:
            raise click.UsageError(
                f"--fix {text}: {number!r} is no number; write {name}=0.5, angles in degrees."
            ) from None
        low, high = getattr(RANGES, name)
        low, high, unit = (low, high, "") if name == "diattenuation" else (degrees(low), degrees(high), " degrees")
        if not low <= value <= high:
            raise click.UsageError(f"--fix {text}: {name} must be from {low:g} to {high:g}{unit}.")
        known[name] = value if name == "diattenuation" else radians(value)
    return known


def declared_model(
    ordering: str,
    gain: str,
    gain_scale: float | None,
    window: tuple[int, int] | None,
    tilt: str,
    tilt_scale: float | None,
    infer_noise: str | None,
    noise_shape: float | None,
    noise_scale: float | None,
    fix: tuple[str, ...],
) -> Model:
    """The model that the options of :func:`model_options` declare."""
    from ..gain import ComplexGain, Gain, PhaseGain
    from ..model import Model

    factor: Gain | None = None
    if gain == "complex":
        if gain_scale is None:
            raise click.UsageError("--gain complex needs --gain-scale: the root mean square amplitude of the gain.")
        factor = ComplexGain(gain_scale)
    elif gain_scale is not None:
        raise click.UsageError("--gain-scale is only for --gain complex.")
    elif gain == "phase":
        factor = PhaseGain()
    parts: dict[str, Any] = {}
    if infer_noise is not None:
        if noise_shape is None or noise_scale is None:
            raise click.UsageError(
                "--infer-noise needs --noise-shape and --noise-scale: a prior of sigma^2 about scale / shape."
            )
        from ..noise import InferredNoise

        parts["noise"] = InferredNoise(noise_shape, noise_scale, infer_noise)
    elif noise_shape is not None or noise_scale is not None:
        raise click.UsageError("--noise-shape and --noise-scale are only for --infer-noise.")
    if window is not None:
        from .. import Window

        parts["neighbours"] = Window(*window)
    if tilt_scale is not None and tilt != "plane":
        raise click.UsageError("--tilt-scale is only for --tilt plane.")
    if tilt == "plane":
        from math import radians

        from ..misalignment import TiltPlane

        parts["misalignment"] = TiltPlane() if tilt_scale is None else TiltPlane(radians(tilt_scale))
    elif tilt == "rotated-basis":
        if window is None:
            raise click.UsageError("--tilt rotated-basis needs --window ROWS COLUMNS, such as 3 5.")
        from ..misalignment import RotatedBasis

        parts["misalignment"] = RotatedBasis()
    return Model(named_ordering(ordering), gain=factor, fixed=_known_values(fix), **parts)


def vacant(path: Path, overwrite: bool) -> None:
    """Refuse to write over a file before the work is done, not after it."""
    if path.exists() and not overwrite:
        raise click.UsageError(f"{path} exists; choose another name or pass --overwrite.")


def measurement_of(path: Path, declared: dict[str, Any]) -> Measurement:
    """The measurement in a file, without its sigma where that is to be inferred."""
    from dataclasses import replace

    from .. import files
    from ..records import Measurement

    data = files.load(path)
    if not isinstance(data, Measurement):
        raise click.UsageError(f"{path} holds a {type(data).__name__}, not a Measurement.")
    if declared["infer_noise"] is not None and data.sigma is not None:
        click.echo("the sigma of the measurement is not used: --infer-noise")
        data = replace(data, sigma=None)
    return data
