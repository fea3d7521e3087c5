"""Commands that this package adds to ``polinfer``: retrieve, recover, reconstruct."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

__all__ = ["reconstruct_command", "recover_command", "retrieve_command"]

_PATH = click.Path(path_type=Path)


def _load(path: Path, kinds: tuple[type, ...]) -> Any:
    from fibre.files import load

    record = load(path)
    if not isinstance(record, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise click.UsageError(f"{path} holds a {type(record).__name__}, not a {wanted}.")
    return record


@click.command("retrieve")
@click.argument("record", type=_PATH)
@click.argument("out", type=_PATH)
@click.option(
    "--method",
    type=click.Choice(["gerchberg-saxton", "accelerated", "modal"]),
    default="gerchberg-saxton",
    show_default=True,
    help="modal: amplitudes of the fibrelets; accelerated: any field.",
)
@click.option("--iterations", type=int, default=150, show_default=True, help="Most sweeps; modal does not need them.")
@click.option("--fibrelets", type=_PATH, help="Calibration fields whose fibrelets to use; needed for a recording.")
@click.option("--track-drift", is_flag=True, help="Follow the tilt of the fibre's light, and take it out.")
@click.option("--resume", "folder", type=_PATH, help="Keep finished captures in this folder, and go on from there.")
@click.option("--overwrite", is_flag=True, help="Replace OUT if it exists.")
def retrieve_command(
    record: Path,
    out: Path,
    method: str,
    iterations: int,
    fibrelets: Path | None,
    track_drift: bool,
    folder: Path | None,
    overwrite: bool,
) -> None:
    """Fields of every capture of RECORD (a Calibration or a Recording), written to OUT.

    Example: polinfer retrieve sample.nc sample-fields.nc --fibrelets calibration-fields.nc --method modal
    """
    import numpy as np

    from fibre import (
        Accelerated,
        Calibration,
        CalibrationFields,
        GerchbergSaxton,
        Modal,
        Recording,
        RecordingFields,
        retrieve_fields,
        save,
    )
    from fibre.fields import fibrelets_of

    data = _load(record, (Calibration, Recording))
    known: Any = None if fibrelets is None else _load(fibrelets, (CalibrationFields,))
    if method == "modal":
        if known is None and isinstance(data, Calibration):
            known = fibrelets_of(data)
        if known is None:
            raise click.UsageError("fibrelets must be given for a Recording; pass --fibrelets calibration-fields.nc.")
        chosen: Any = Modal(known.fibrelets if isinstance(known, CalibrationFields) else known)
    else:
        chosen = {"gerchberg-saxton": GerchbergSaxton, "accelerated": Accelerated}[method](iterations=iterations)
    fields = retrieve_fields(
        data, chosen, fibrelets=known, progress=True, drift="track" if track_drift else None, folder=folder
    )
    click.echo(f"wrote {save(fields, out, overwrite=overwrite)}")
    parts = [fields.status] + ([fields.blank_status] if isinstance(fields, RecordingFields) else [])
    status = np.concatenate(parts)
    if status.any():
        click.echo(f"{np.count_nonzero(status)} of {len(status)} captures did not converge or misfit their images")
    h, v = np.broadcast_to(fields.inflation, 2)
    said = f"noise beyond the images': H x {h:.2f}, V x {v:.2f}, and {100 * fields.relative_error:.2f} % of the field"
    if isinstance(fields, CalibrationFields):
        said += f", and {100 * fields.stray:.2f} % of its mean"
    click.echo(said)


@click.command("recover")
@click.argument("fields", type=_PATH)
@click.argument("out", type=_PATH)
@click.option(
    "--method",
    type=click.Choice(["forward-inverse", "ridge", "basis-pursuit", "weighted-sum"]),
    default="forward-inverse",
    show_default=True,
    help="basis-pursuit is the published one.",
)
@click.option("--window", type=float, help="Side of the window, micrometres; by default the method's own.")
@click.option("--resume", "folder", type=_PATH, help="Keep finished rows in this folder, and go on from there.")
@click.option("--cost", "only_cost", is_flag=True, help="Say what it will take, and stop.")
@click.option("--overwrite", is_flag=True, help="Replace OUT if it exists.")
def recover_command(
    fields: Path, out: Path, method: str, window: float | None, folder: Path | None, only_cost: bool, overwrite: bool
) -> None:
    """Inverse transmission matrix from the calibration FIELDS, written to OUT.

    Example: polinfer recover calibration-fields.nc inverse.nc
    """
    from fibre import BasisPursuit, CalibrationFields, ForwardInverse, Ridge, WeightedSum, recover, save

    kinds: dict[str, Any] = {
        "forward-inverse": ForwardInverse,
        "ridge": Ridge,
        "basis-pursuit": BasisPursuit,
        "weighted-sum": WeightedSum,
    }
    chosen = kinds[method]() if window is None else kinds[method](window=window * 1e-6)
    data = _load(fields, (CalibrationFields,))
    click.echo(str(chosen.cost(data)))
    if only_cost:
        return
    inverse = recover(data, chosen, progress=True, folder=folder)
    click.echo(f"wrote {save(inverse, out, overwrite=overwrite)}")


@click.command("reconstruct")
@click.argument("inverse", type=_PATH)
@click.argument("fields", type=_PATH)
@click.argument("out", type=_PATH)
@click.option("--overwrite", is_flag=True, help="Replace OUT if it exists.")
def reconstruct_command(inverse: Path, fields: Path, out: Path, overwrite: bool) -> None:
    """Jones data at the distal facet from INVERSE and recorded FIELDS, written to OUT for `polinfer fit`.

    Example: polinfer reconstruct inverse.nc sample-fields.nc measurement.nc
    """
    from fibre import Inverse, RecordingFields, reconstruct, save

    measurement = reconstruct(_load(inverse, (Inverse,)), _load(fields, (RecordingFields,)))
    click.echo(
        f"wrote {save(measurement, out, overwrite=overwrite)}: {measurement.shape} points, {measurement.states} states"
    )
