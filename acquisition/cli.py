"""Commands that this package adds to ``polinfer``: demo, devices, acquire, report."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import click

__all__ = ["acquire_command", "demo_command", "devices_command", "report_command"]


@click.command("demo")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default=Path("polinfer-demo"))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of scene and noise.")
@click.option(
    "--full", is_flag=True, help="The published size, 1200 x 1200 pixels: some ten minutes, and 3 GB of disk."
)
def demo_command(folder: Path, seed: int, full: bool) -> None:
    """Run the whole instrument on a simulated bench and compare with the truth; records go to FOLDER.

    Camera frames are simulated, merged, phase-retrieved, sent through the recovered inverse of the fibre and fitted.
    A report.html shows maps, posteriors, the verdict on the ordering and texture. About a minute on two cores and
    150 MB of disk.

    Example: polinfer demo my-demo --seed 3
    """
    from acquisition.demo import full_setup, report, run_demo, stages

    click.echo(f"Writing to {folder.resolve()}")
    result = run_demo(folder, seed, progress=True, page=True, setup=full_setup(seed) if full else None)
    click.echo("")
    stages(result, click.echo)
    report(result, click.echo)
    click.echo("\nWrote, beside the raw frames:")
    for path in result.files:
        click.echo(f"  {path}")


@click.command("report")
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="The page; by default FOLDER/report.html.")
@click.option("--title", default="Polarisation of a sample", show_default=True)
@click.option("--pixel-size", type=float, help="Micrometres between pixels, for scale bars.")
@click.option(
    "--simulations", type=click.IntRange(min=0), default=40, show_default=True, help="For the power; 0: none."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
def report_command(
    folder: Path, out: Path | None, title: str, pixel_size: float | None, simulations: int, seed: int
) -> None:
    """Write one page about the sample in FOLDER (measurement.nc and fit.nc): maps, uncertainty, verdict, provenance.

    Example: polinfer report my-demo --pixel-size 4.2
    """
    from acquisition.reporting import write_report

    try:
        size = None if pixel_size is None else pixel_size * 1e-6
        path = write_report(folder, out, title, pixel_size=size, simulations=simulations, rng=seed)
    except (FileNotFoundError, TypeError, ValueError) as error:
        raise click.ClickException(str(error)) from error
    click.echo(f"wrote {path}")


@click.command("devices")
@click.option("--rule", is_flag=True, help="Print the udev rule that lets users open the devices.")
def devices_command(rule: bool) -> None:
    """List the cameras, instruments and modulators that are connected.

    Example: polinfer devices
    """
    from acquisition.errors import AcquisitionError
    from acquisition.usb.discovery import RULE, list_devices

    if rule:
        click.echo(RULE, nl=False)
        return
    try:
        found = list_devices()
    except AcquisitionError as error:
        raise click.ClickException(str(error)) from error
    if not found:
        click.echo("no device that polinfer has a driver for is connected")
    for one in found:
        text = f"{one.kind:<11s}{one.serial or '?':<24s}{one.vendor:04x}:{one.product:04x}  {one.name}"
        click.echo(text + (f"  ({one.problem})" if one.problem else ""))


@click.command("acquire")
@click.argument("plan", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@click.option("--dry-run", is_flag=True, help="Say what would be captured and how long it takes; open nothing.")
@click.option("--reference-seconds", type=float, help="Take a further reference where the last is older than this.")
@click.option(
    "--export", type=click.Path(path_type=Path), help="Write the record to this file (.nc, .zarr) at the end."
)
@click.option(
    "--preview", type=click.Path(path_type=Path), help="Write the first view as a picture to this file first."
)
def acquire_command(
    plan: Path, folder: Path, dry_run: bool, reference_seconds: float | None, export: Path | None, preview: Path | None
) -> None:
    """Capture what PLAN (a TOML file) says into FOLDER; the same command goes on where it was interrupted.

    Example: polinfer acquire calibration.toml run-1 --dry-run
    """
    from acquisition.errors import AcquisitionError
    from acquisition.plan import GridPlan, SamplePlan, Timing
    from acquisition.planfile import open_bench, read_plan
    from acquisition.recording import Folder
    from acquisition.run import calibrate, capture
    from fibre import save

    try:
        wanted, devices = read_plan(plan)
        kinds = [step.kind for step in wanted.captures]
        counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        seconds = wanted.duration(Timing())
        click.echo(f"{len(kinds)} captures ({counts}) of {len(wanted.views)} images; plan {wanted.hash[:12]}")
        click.echo(f"at the published {Timing().image:.2f} s an image: {seconds / 60:.1f} minutes")
        if dry_run:
            return
        with contextlib.ExitStack() as stack:
            bench = open_bench(devices, wanted)
            if isinstance(bench, contextlib.AbstractContextManager):  # of devices, which are made safe and closed
                stack.enter_context(bench)
            if preview is not None:
                _preview(bench, wanted, preview)
                click.echo(f"wrote {preview}")
            record: object
            if isinstance(wanted, GridPlan):
                record = calibrate(bench, wanted, folder, True, reference_seconds)
            elif isinstance(wanted, SamplePlan):
                record = capture(bench, wanted, folder, True, reference_seconds)
            store = Folder(folder, {"plan": wanted.hash, "bench": bench.describe()})
        size = sum(line["bytes"] for line in store.done.values())
        click.echo(f"{len(store.done)} captures, {size / 1e6:.0f} MB, in {folder}")
        if export is not None:
            click.echo(f"wrote {save(record, export)}")
    except (AcquisitionError, ValueError, TypeError) as error:
        raise click.ClickException(str(error)) from error


def _preview(bench: Any, plan: Any, path: Path) -> None:
    """The first view of the first step that is no reference, at the longest exposure that does not saturate."""
    from matplotlib.figure import Figure

    from acquisition.contracts import bracketed
    from acquisition.plan import GridPlan

    step = next(step for step in plan.captures if step.kind != "reference")
    points = plan.points if isinstance(plan, GridPlan) else None
    bench.prepare(step, plan.views, plan.illumination, points)
    frame = bracketed(bench, 0, plan.views.bracket)[-1]
    figure = Figure(figsize=(6, 5), layout="constrained")
    axes = figure.subplots()
    shown = axes.imshow(frame.counts, cmap="gray", vmin=0, vmax=bench.full_scale, interpolation="nearest")
    figure.colorbar(shown, label="counts")
    full = int((frame.counts >= bench.full_scale).sum())
    axes.set_title(f"{step.id}, {1e3 * frame.exposure:.3g} ms, {full} pixels saturated")
    figure.savefig(path, dpi=120)
