"""Arrays and a JSON header in one .npz file, written whole or not at all, and checked when read."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

_HEADER = "header"


class SweepFileError(ValueError):
    """A sweep or checkpoint file that is damaged, foreign, or of another sweep."""


def write_file(
    path: Path, header: dict[str, Any], arrays: dict[str, np.ndarray], *, compress: bool
) -> None:
    """Write atomically: a temporary file beside ``path``, flushed to disk, then renamed.

    A process killed at any instant leaves the old file or the new one, never a part.
    """
    sealed = {**header, "checksum": _checksum(header, arrays)}
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            save = np.savez_compressed if compress else np.savez
            text = np.frombuffer(json.dumps(sealed, sort_keys=True).encode(), np.uint8)
            save(file, **{_HEADER: text}, **arrays)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def read_file(path: Path, schema: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file that ``write_file`` wrote.

    Raises:
        SweepFileError: No such file, not one of ours, of another schema, or damaged; the message
            names the file.
    """
    if not path.is_file():
        raise SweepFileError(f"{path}: no such file")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop(_HEADER).tobytes())
        found = header["schema"]
        checksum = header.pop("checksum")
    except (OSError, EOFError, zipfile.BadZipFile, ValueError, KeyError, TypeError) as error:
        raise SweepFileError(f"{path}: not a sweep file, or damaged ({error})") from error
    except Exception as error:  # zlib.error and whatever else a damaged stream may raise
        raise SweepFileError(f"{path}: damaged ({error})") from error
    if found != schema:
        raise SweepFileError(f"{path}: schema is {found!r}, expected {schema!r}")
    if checksum != _checksum(header, arrays):
        raise SweepFileError(f"{path}: damaged, its checksum does not match its contents")
    return header, arrays


def _checksum(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()
