"""Finished parts of a long computation in a folder, so that the same call goes on where it was interrupted.

In: a fingerprint of all that the result depends on. Out: records by name, each in a file of its own. Called by
``summarise`` and, in the package above, by the verbs over many captures and rows.
"""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from polinfer import storage

__all__ = ["Kept", "fingerprint"]

NAME = "settings.txt"


def fingerprint(*parts: Any) -> str:
    """A hash of declarations, numbers and trees of arrays: of all that a result depends on.

    >>> fingerprint(1, np.zeros(2)) == fingerprint(1, np.zeros(2)), fingerprint(1) == fingerprint(2)
    (True, False)
    """
    digest = hashlib.sha256()
    for part in parts:
        if is_dataclass(part) and not isinstance(part, type):
            digest.update(type(part).__name__.encode())
            digest.update(fingerprint(*(getattr(part, f.name) for f in fields(part))).encode())
            continue
        leaves = jax.tree.leaves(part)
        if leaves and all(isinstance(leaf, np.ndarray | np.generic) for leaf in leaves):
            for leaf in leaves:
                digest.update(f"{leaf.dtype}{leaf.shape}".encode() + np.ascontiguousarray(leaf).tobytes())
        else:
            digest.update(repr(part).encode())
        digest.update(b";")
    return digest.hexdigest()


class Kept:
    """Records in a folder that belongs to one call.

    folder: made if absent. name: the call's :func:`fingerprint`. kinds: the types that a file may be made of, the
    record's own first. belongs_to: what another call would differ in, for the error.

    Raises
    ------
    ValueError: the folder belongs to another call or holds other files.

    >>> import tempfile
    >>> from polinfer import Measurement
    >>> kept = Kept(Path(tempfile.mkdtemp()) / "new", fingerprint("call"), (Measurement,), "call")
    >>> kept.read("first") is None
    True
    >>> kept.write("first", Measurement(np.eye(2), np.eye(2), sigma=0.1))
    >>> kept.read("first").sigma.item()
    0.1
    """

    def __init__(self, folder: str | Path, name: str, kinds: tuple[type, ...], belongs_to: str) -> None:
        self.folder, self.kinds = Path(folder), kinds
        file = self.folder / NAME
        if file.exists():
            if file.read_text().strip() != name:
                raise ValueError(
                    f"folder: {folder} belongs to another {belongs_to}; choose another one, or remove it to start anew."
                )
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        if any(self.folder.iterdir()):
            raise ValueError(f"folder: {folder} holds other files; choose an empty one.")
        file.write_text(name + "\n")

    def _path(self, part: str) -> Path:
        return self.folder / f"{part}.nc"

    def read(self, part: str) -> Any:
        """A part that is finished, None: not yet. Raises ValueError for a damaged file."""
        path = self._path(part)
        if not path.exists():
            return None
        found = storage.load(path, self.kinds)
        if not isinstance(found, self.kinds[0]):
            raise ValueError(f"folder: {path} holds no {self.kinds[0].__name__}; remove it to make this part anew.")
        return found

    def write(self, part: str, record: Any) -> None:
        """Keep a finished part."""
        storage.save(record, self._path(part))
