"""Value networks in files: a line of JSON that says what it is, then the arrays.

The header names the robot, the version of the features and how the network was made; its digest of
the arrays tells a truncated or altered file.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from muxjax.config import ConfigError, data_folder, replacing
from muxjax.planning.value import FEATURES, ValueNet, n_features
from muxjax.robot import Robot

SCHEMA = "muxjax/value/1"
SUFFIX = ".value"
_LONGEST_HEADER = 100_000


class CheckpointError(ConfigError):
    """A checkpoint that cannot be used; the message says why."""


def save_value(path: str | Path, net: ValueNet, robot: Robot, about: Mapping[str, Any]) -> None:
    """Write a network; an existing file is replaced in one stroke.

    Args:
        path: Ends in ".value".
        net: The network.
        robot: The robot it was trained for.
        about: What a reader should know: configuration, seed, commit, scores.
    """
    path = Path(path)
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {}
    for i, (weight, bias) in enumerate(zip(net.weights, net.biases, strict=True)):
        arrays[f"weight{i}"], arrays[f"bias{i}"] = np.asarray(weight), np.asarray(bias)
    np.savez(buffer, **arrays)
    content = buffer.getvalue()
    header = {
        "schema": SCHEMA,
        "features": FEATURES,
        "robot": robot.config.name,
        "fingerprint": robot.fingerprint,
        "sizes": [len(net.weights[0]), *(len(b) for b in net.biases)],
        "digest": hashlib.sha256(content).hexdigest(),
        "about": dict(about),
    }
    with replacing(path) as part:
        part.write_bytes(json.dumps(header).encode() + b"\\n" + content)


def checkpoint_path(name_or_path: str | Path) -> Path:
    """A shipped checkpoint by its bare name, or a file by its path, which ends in ".value".

    Raises:
        CheckpointError: No such file; the message lists the shipped names.
    """
    path = Path(name_or_path)
    if path.suffix == SUFFIX:
        if not path.is_file():
            raise CheckpointError(f"{path}: no such file")
        return path
    shipped = data_folder("checkpoints")
    found = shipped / f"{name_or_path}{SUFFIX}"
    if path.name != str(name_or_path) or not found.is_file():
        names = ", ".join(sorted(p.stem for p in shipped.glob(f"*{SUFFIX}"))) or "none"
        raise CheckpointError(
            f"checkpoint: no {str(name_or_path)!r} among the shipped ones ({names}); a file of "
            f"your own is named by a path ending in {SUFFIX}"
        )
    return found


def load_value(name_or_path: str | Path, robot: Robot) -> tuple[ValueNet, dict[str, Any]]:
    """A network for a robot, and its header.

    Raises:
        CheckpointError: No such file, not a checkpoint, truncated or altered, of another version,
            or of another robot.
    """
    path = checkpoint_path(name_or_path)
    return _loaded(path, path.stat().st_mtime_ns, robot.fingerprint, n_features(robot))


@lru_cache(maxsize=8)
def _loaded(
    path: Path, changed: int, fingerprint: str, inputs: int
) -> tuple[ValueNet, dict[str, Any]]:
    del changed  # part of the key only
    first, _, content = path.read_bytes().partition(b"\\n")
    try:
        header = json.loads(first[:_LONGEST_HEADER])
        schema = header["schema"]
    except (ValueError, TypeError, KeyError):
        raise CheckpointError(f"{path}: is no checkpoint of a value network") from None
    for field, found, expected in (
        ("schema", schema, SCHEMA),
        ("version of the features", header.get("features"), FEATURES),
        ("fingerprint of the robot", header.get("fingerprint"), fingerprint),
    ):
        if found != expected:
            raise CheckpointError(
                f"{path}: {field} is {found!r}, needed is {expected!r} (it was trained for the "
                f"robot {header.get('robot')!r})"
            )
    if hashlib.sha256(content).hexdigest() != header.get("digest"):
        raise CheckpointError(f"{path}: truncated or altered, its digest is another one")
    arrays = np.load(io.BytesIO(content))
    layers = range(len(arrays.files) // 2)
    net = ValueNet(
        tuple(arrays[f"weight{i}"] for i in layers), tuple(arrays[f"bias{i}"] for i in layers)
    )
    if len(net.weights[0]) != inputs:
        raise CheckpointError(
            f"{path}: takes {len(net.weights[0])} features, the robot has {inputs}"
        )
    return net, header
