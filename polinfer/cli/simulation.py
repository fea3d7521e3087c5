"""The command ``polinfer simulate``."""

from __future__ import annotations

from pathlib import Path

import click

from .options import PATH, named_ordering, ordering_option, overwrite_option, vacant

__all__ = ["simulate_command"]


@click.command("simulate")
@click.argument("out", type=PATH)
@click.option(
    "--shape",
    nargs=2,
    type=click.IntRange(min=1),
    default=(27, 36),
    show_default="27 36",
    metavar="ROWS COLUMNS",
    help="Pixels of the frame.",
)
@click.option("--sigma", type=float, default=0.05, show_default=True, help="Noise, in units of the incident field.")
@click.option(
    "--states",
    type=click.IntRange(min=2),
    default=3,
    show_default=True,
    help="Illumination states: balanced ones, (1, exp(2 pi i k / states)) / sqrt(2).",
)
@click.option("--jones", is_flag=True, help="Measured Jones matrices instead: horizontal and vertical states.")
@ordering_option
@click.option(
    "--gain",
    type=click.Choice(["none", "phase", "complex"]),
    default="none",
    show_default=True,
    help="Complex factor of every pixel: 1; the scene's phase; its amplitude, 0.6 to 1, and phase.",
)
@click.option(
    "--tilt",
    nargs=3,
    type=float,
    metavar="PISTON ROWS COLUMNS",
    help="Phase plane between the two arms: at the centre, and from edge to edge, degrees.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    show_default="drawn, and printed",
    help="Seed of the scene; the noise takes the next one.",
)
@click.option("--truth", type=PATH, help="Also write the scene (a Phantom with the gain that was used) to this file.")
@overwrite_option
@click.pass_context
def simulate_command(
    ctx: click.Context,
    out: Path,
    shape: tuple[int, int],
    sigma: float,
    states: int,
    jones: bool,
    ordering: str,
    gain: str,
    tilt: tuple[float, float, float] | None,
    seed: int | None,
    truth: Path | None,
    overwrite: bool,
) -> None:
    """Simulate the measurement of a lesion and write it to OUT (.nc or .zarr), for `polinfer fit`.

    Example: polinfer simulate measurement.nc --shape 27 36 --sigma 0.05 --gain complex --seed 1 --truth truth.nc
    """
    from dataclasses import replace

    import numpy as np

    from .. import phantoms, storage
    from ..checks import as_generator
    from ..misalignment import TiltPlane
    from ..model import Model
    from ..simulation import simulate

    if jones and ctx.get_parameter_source("states") is click.core.ParameterSource.COMMANDLINE:
        raise click.UsageError("--jones means two states, horizontal and vertical; leave out --states.")
    for path in (out, truth):
        if path is not None:
            vacant(path, overwrite)
    if truth is not None and truth.resolve() == out.resolve():
        raise click.UsageError(f"--truth {truth} is OUT; choose another name.")
    seed = as_generator(None)[1] if seed is None else seed
    assert seed is not None
    scene = phantoms.lesion(shape, rng=seed)
    factor = {"none": np.ones(shape, complex), "phase": scene.gain / np.abs(scene.gain), "complex": scene.gain}[gain]
    scene = replace(scene, gain=factor, tilt=None if tilt is None else TiltPlane().phase(np.radians(tilt), shape))
    if jones:
        illumination = np.eye(2, dtype=complex)
    else:
        illumination = np.stack([np.ones(states), np.exp(2j * np.pi * np.arange(states) / states)]) / np.sqrt(2)
    # with one seed for both, the noise would repeat the draws of which the scene is made
    data = simulate(
        Model(named_ordering(ordering)),
        scene.parameters,
        illumination,
        sigma,
        rng=seed + 1,
        gain=scene.gain,
        tilt=scene.tilt,
    )
    storage.save(data, out, overwrite=overwrite)
    if truth is not None:
        storage.save(scene, truth, overwrite=overwrite)
    click.echo(f"wrote {out}: {shape[0]} x {shape[1]} pixels, {data.states} states, sigma {sigma:g}, seed {seed}")
    if truth is not None:
        click.echo(f"wrote {truth}: the scene")
