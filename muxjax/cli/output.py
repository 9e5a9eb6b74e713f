"""What commands print: tables for a person, JSON for a machine."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Union

import numpy as np
import scipy
import tyro
from rich.console import Console

# Units stand in square brackets, which would otherwise be taken for markup.
console = Console(markup=False, highlight=False)
if not console.is_terminal:
    console.width = 120  # a file or a pipe has no width; the default of 80 would break the tables


def choice_of(commands: Mapping[str, Callable[..., Any]]) -> Any:
    """Type of an argument that is one of these subcommands, its value what the command returns."""
    members = (
        Annotated[Any, tyro.conf.subcommand(name=name, constructor=call, prefix_name=False)]
        for name, call in commands.items()
    )
    return Union[tuple(members)]  # noqa: UP007 - built at run time


def notice(text: str) -> None:
    """Say something that is not the result: standard output may be JSON for a machine."""
    print(text, file=sys.stderr, flush=True)


def print_json(document: Any) -> None:
    """Print a document of numbers, arrays and text; JSON has no NaN, it becomes null."""
    print(json.dumps(_plain(document), indent=2))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


def row_of(values: Any, scale: float = 1.0, digits: int = 2) -> str:
    """Scaled numbers side by side, without a minus before zero."""
    return "  ".join(f"{round(scale * v, digits) + 0.0:.{digits}f}" for v in values)


def pose_document(pose: Any) -> dict[str, Any]:
    """A pose in every common notation."""
    turn = scipy.spatial.transform.Rotation.from_matrix(pose[:3, :3])
    return {
        "position_m": pose[:3, 3],
        "quaternion_wxyz": turn.as_quat(scalar_first=True, canonical=True),
        "rpy_deg": turn.as_euler("xyz", degrees=True),
        "matrix": pose,
    }
