"""Commands that this package adds to ``polinfer``: demo."""

from __future__ import annotations

from pathlib import Path

import click

__all__ = ["demo_command"]


@click.command("demo")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default=Path("polinfer-demo"))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of scene and noise.")
def demo_command(folder: Path, seed: int) -> None:
    """Run the whole instrument on a simulated bench and compare with the truth; records go to FOLDER.

    Camera frames are simulated, merged, phase-retrieved, sent through the recovered inverse of the fibre and fitted.
    About a minute on two cores and 150 MB of disk.

    Example: polinfer demo my-demo --seed 3
    """
    from acquisition.demo import report, run_demo

    click.echo(f"Writing to {folder.resolve()}")
    result = run_demo(folder, seed, progress=True)
    click.echo("\nSeconds by stage: " + ", ".join(f"{name} {value:.1f}" for name, value in result.seconds.items()))
    click.echo(f"Total {sum(result.seconds.values()):.0f} s\n")
    report(result, click.echo)
    click.echo("\nWrote, beside the raw frames:")
    for path in result.files:
        click.echo(f"  {path}")
