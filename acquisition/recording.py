"""Raw frames on disk and the manifest that says which are complete.

One file of raw frames per capture, written under another name, flushed to the disk and renamed; then one line in an
append-only manifest, flushed too. A capture exists when its line does. In: frames. Out: the same frames. Called by the
run.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.errors import RunMismatch

__all__ = ["Folder"]

MANIFEST = "manifest.jsonl"


class Folder:
    """A run's folder. A new one gets ``header`` as its first line; an old one must have been made by the same."""

    def __init__(self, path: str | Path, header: dict[str, Any]) -> None:
        self.path = Path(path)
        self.path.mkdir(parents=True, exist_ok=True)
        self.manifest = self.path / MANIFEST
        self.done: dict[str, dict[str, Any]] = {}
        lines = self._read()
        self.lines = 0
        if not lines:
            self._append(header)
            return
        if lines[0] != header:
            differing = sorted(k for k in {*lines[0], *header} if lines[0].get(k) != header.get(k))
            raise RunMismatch(
                f"folder {self.path} belongs to another run ({', '.join(differing)} differ); choose another folder."
            )
        for line in lines[1:]:
            self.done.pop(line["id"], None)  # what was taken again counts from then
            if not line.get("void"):
                self.done[line["id"]] = line
        self.lines = len(lines) - 1

    def _read(self) -> list[dict[str, Any]]:
        if not self.manifest.exists():
            return []
        raw = self.manifest.read_bytes()
        whole = raw[: raw.rfind(b"\n") + 1]
        if len(whole) < len(raw):
            # a torn last line: the capture it speaks of was never acknowledged
            with open(self.manifest, "r+b") as file:
                file.truncate(len(whole))
        try:
            lines = [json.loads(line) for line in whole.splitlines()]
        except ValueError as error:  # not JSON, or not even text
            raise ValueError(f"folder {self.path} has a damaged {MANIFEST} ({error}); it cannot be resumed.") from error
        parts = {"id", "bytes", "sha256", "exposures", "time", "ended"}
        if not all(isinstance(line, dict) for line in lines) or any(
            not (parts <= line.keys() or {"id", "void"} <= line.keys()) for line in lines[1:]
        ):
            raise ValueError(f"folder {self.path} has a foreign {MANIFEST}; choose another folder.")
        return lines

    def _append(self, line: dict[str, Any]) -> None:
        with open(self.manifest, "ab") as file:
            file.write(json.dumps(line).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        self._sync_directory()

    def _sync_directory(self) -> None:
        descriptor = os.open(self.path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def void(self, identity: str) -> None:
        """A capture that does not count any more, although its frames are there: it is to be taken again."""
        self._append({"id": identity, "void": True})
        self.lines += 1
        self.done.pop(identity, None)

    def store(
        self,
        identity: str,
        frames: list[np.ndarray],
        exposures: list[list[float]],
        time: float,
        ended: float,
        **more: Any,
    ) -> None:
        """Keep a capture from ``time`` to ``ended``: ``frames[i]`` are the raw exposures (k, y, x) of image i,
        ``exposures[i]`` seconds, as the camera says they were; ``more`` goes into the manifest, as JSON."""
        name = f"{identity}.npz"
        part = self.path / f".{name}.part"
        with open(part, "wb") as file:
            named: dict[str, Any] = {f"image_{i:03d}": frame for i, frame in enumerate(frames)}
            np.savez(file, **named)
            file.flush()
            os.fsync(file.fileno())
        digest = hashlib.sha256(part.read_bytes()).hexdigest()
        size = part.stat().st_size
        os.replace(part, self.path / name)
        self._sync_directory()
        line = {"id": identity, "file": name, "bytes": size, "sha256": digest, "exposures": exposures, "time": time,
                "ended": ended, **more}  # fmt: skip
        self._append(line)
        self.lines += 1
        self.done[identity] = line

    def load(self, identity: str) -> tuple[list[np.ndarray], list[list[float]]]:
        """Raw frames and exposures of a capture, checked against the manifest."""
        line = self.done[identity]
        path = self.path / f"{identity}.npz"
        raw = path.read_bytes() if path.exists() else b""
        if hashlib.sha256(raw).hexdigest() != line["sha256"]:
            raise ValueError(f"folder {self.path}: {path.name} is damaged or missing; delete its line in {MANIFEST} to "
                             "take it again.")  # fmt: skip
        with np.load(path, allow_pickle=False) as stored:
            frames = [stored[f"image_{i:03d}"] for i in range(len(line["exposures"]))]
        return frames, line["exposures"]

    def complete(self, identity: str) -> bool:
        """Whether the capture is in the manifest and its file has the stated size."""
        if identity not in self.done:
            return False
        path = self.path / f"{identity}.npz"
        return path.exists() and path.stat().st_size == self.done[identity]["bytes"]
