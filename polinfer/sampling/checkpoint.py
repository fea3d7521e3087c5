"""The state of an interrupted ensemble: one ``.npz`` file, replaced as a whole, in which nothing is pickled."""

from __future__ import annotations

import os
import time
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Checkpoint", "Earlier"]

EVERY = 5.0  # seconds between two writes


class Earlier(NamedTuple):
    """Records so far ``(time, walker, k)`` and ``(time, walker)``, and the state of emcee to go on from."""

    places: np.ndarray
    values: np.ndarray
    now: np.ndarray
    now_values: np.ndarray
    random_state: tuple[str, np.ndarray, int, int, float]


class Checkpoint:
    """A file that holds one ensemble. ``name`` says which one: a file of another one is refused (ValueError).

    >>> import tempfile
    >>> Checkpoint(Path(tempfile.mkdtemp()) / "a.npz", "name").read() is None
    True
    """

    def __init__(self, path: Path, name: str) -> None:
        self.path, self.name = path, name
        self.written = time.monotonic()

    def read(self) -> Earlier | None:
        """What was written, or None: nothing yet."""
        if not self.path.exists():
            return None
        try:
            with np.load(self.path, allow_pickle=False) as file:
                found = {key: file[key] for key in file.files}
            name = str(found["name"])
            random = ("MT19937", found["keys"].astype(np.uint32), int(found["position"]), int(found["has_gauss"]),
                      float(found["gauss"]))  # fmt: skip
            earlier = Earlier(found["places"], found["values"], found["now"], found["now_values"], random)
        except (ValueError, KeyError, OSError, EOFError, TypeError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"backend: {self.path} is damaged or foreign ({error}); remove it to start anew."
            ) from error
        if name != self.name:
            raise ValueError(
                f"backend: {self.path} belongs to another model, measurement, seed or setting of the sampler; "
                "choose another folder, or remove it to start anew."
            )
        return earlier

    def write(self, places: np.ndarray, values: np.ndarray, state: Any, last: bool) -> None:
        """Keep the records and the state, now and then and after the ``last`` one."""
        if not last and time.monotonic() - self.written < EVERY:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_suffix(".part")
        _, keys, position, has_gauss, gauss = state.random_state
        with part.open("wb") as file:
            np.savez(file, name=self.name, places=places, values=values, now=state.coords, now_values=state.log_prob,
                     keys=keys, position=position, has_gauss=has_gauss, gauss=gauss)  # fmt: skip
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, self.path)
        self.written = time.monotonic()
