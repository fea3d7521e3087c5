"""Readers of published measurements."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .storage import array

__all__ = ["FibreMatrix", "data_directory", "multimode_fibre", "noise_upper_bound"]

_MODES = 55


@dataclass(frozen=True, eq=False)
class FibreMatrix:
    """Measured transmission matrix of a multimode fibre, as one Jones matrix per pair of modes.

    ``jones`` complex ``(mode_out, mode_in, 2, 2)``, arbitrary unit: column 0 is the response to horizontal input.
    ``near_degenerate`` bool ``(mode_out, mode_in)``: pairs of nearly the same propagation constant, which hold most of
    the energy. ``position`` of the press that deforms the fibre, mm as published.
    """

    jones: np.ndarray = array(("mode_out", "mode_in", "row", "column"), "1")
    near_degenerate: np.ndarray = array(("mode_out", "mode_in"), "1")
    position: str = ""


def data_directory(directory: str | Path | None = None) -> Path:
    """The folder of data sets: the argument, else the environment variable ``POLINFER_DATA``, else ``shared/data``
    beside the checkout.

    Raises
    ------
    FileNotFoundError: there is no such folder.

    >>> import tempfile
    >>> data_directory(tempfile.gettempdir()) == Path(tempfile.gettempdir())
    True
    """
    if directory is None:
        directory = os.environ.get("POLINFER_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data"
    if not Path(directory).is_dir():
        raise FileNotFoundError(f"directory {directory} with data sets does not exist; set POLINFER_DATA to yours.")
    return Path(directory)


def _read(path: Path, key: str | None, shape: tuple[int, ...], kind: str) -> np.ndarray:
    if not path.is_file():
        raise FileNotFoundError(f"directory has no {path.name}; expected it at {path}.")
    content = np.load(path, allow_pickle=False)
    if key is None:
        values = content
    else:
        with content:
            if key not in content:
                raise ValueError(f"{path} has no array {key!r}, only {sorted(content)}; is it the right file?")
            values = content[key]
    if values.shape != shape or values.dtype.kind != kind:
        raise ValueError(f"{path} holds {values.dtype} of shape {values.shape}, expected kind {kind!r} and {shape}.")
    if not np.isfinite(values).all():
        raise ValueError(f"{path} holds values that are not finite.")
    return np.asarray(values)


def multimode_fibre(state: str = "5.0", directory: str | Path | None = None) -> FibreMatrix:
    """Transmission matrix of a graded-index multimode fibre pressed at ``state``.

    55 spatial modes in two polarisations: the file holds a 110 x 110 matrix of four blocks ``[[hh, hv], [vh, vv]]``
    (the order of the blocks is not stated by the authors and is our reading), which become 55 x 55 Jones matrices.

    Parameters
    ----------
    state: position of the press in mm as in the file name, such as "5.0" or "5.044".
    directory: see :func:`data_directory`; the files are in its folder ``mmf_tm_measured``.

    Raises
    ------
    FileNotFoundError: folder or file missing. ValueError: a file with other contents.

    Source: Matthes et al., Phys. Rev. X 11, 021060 (2021), data under the MIT licence,
    https://github.com/wavefrontshaping/article_MMF_disorder

    >>> multimode_fibre("5.0", "nowhere")
    Traceback (most recent call last):
    ...
    FileNotFoundError: directory nowhere with data sets does not exist; set POLINFER_DATA to yours.
    """
    folder = data_directory(directory) / "mmf_tm_measured"
    size = 2 * _MODES
    matrix = _read(folder / f"TM_modes_{state}.npz", "TM_corr_modes", (size, size), "c")
    mask = _read(folder / "mask_near_degenerate.npy", None, (_MODES, _MODES), "b")
    blocks = matrix.reshape(2, _MODES, 2, _MODES)
    return FibreMatrix(np.ascontiguousarray(blocks.transpose(1, 3, 0, 2)), mask, state)


def noise_upper_bound(first: FibreMatrix, second: FibreMatrix) -> tuple[float, np.ndarray]:
    """An upper bound on the noise from two measurements that differ a little.

    The second is first scaled by the complex factor that fits best. What is left holds the noise of both and the
    change of the fibre, hence at most ``sqrt(2)`` times the noise of one.

    Returns
    -------
    sigma (root mean square of a complex element over ``sqrt(2)``, unit of the matrices) and the same for each pair of
    modes, ``(mode_out, mode_in)``.

    >>> same = FibreMatrix(np.ones((2, 2, 2, 2), complex), np.ones((2, 2), bool), "5.0")
    >>> noise_upper_bound(same, same)[0]
    0.0
    """
    factor = np.vdot(second.jones, first.jones) / np.vdot(second.jones, second.jones)
    square = np.abs(first.jones - factor * second.jones) ** 2 / 2
    return float(np.sqrt(square.mean())), np.sqrt(square.mean(axis=(-1, -2)))
