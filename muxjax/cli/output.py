"""What commands print: tables for a person, JSON for a machine."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Union

import numpy as np
import scipy
import tyro
from rich.console import Console
from rich.text import Text
from rich.theme import Theme

from muxjax.kinematics import check_configuration, roll_pitch_yaw
from muxjax.robot import Robot

# rich leaves colours out where the output is no terminal, and where NO_COLOR is set.
_THEME = Theme({"table.header": "bold cyan", "good": "green", "bad": "bold red", "aside": "dim"})


def make_console(*, stderr: bool = False) -> Console:
    """A console of the command line, to standard output or to standard error."""
    # Units stand in square brackets, which would otherwise be taken for markup.
    made = Console(stderr=stderr, theme=_THEME, markup=False, highlight=False, emoji=False)
    if not made.is_terminal:
        made.width = 120  # a file or a pipe has no width; the default of 80 would break the tables
    return made


console, errors = make_console(), make_console(stderr=True)


def choice_of(commands: Mapping[str, Callable[..., Any]]) -> Any:
    """Type of an argument that is one of these subcommands, its value what the command returns."""
    members = (
        Annotated[Any, tyro.conf.subcommand(name=name, constructor=call, prefix_name=False)]
        for name, call in commands.items()
    )
    return Union[tuple(members)]  # noqa: UP007 - built at run time


def notice(text: str) -> None:
    """Say something that is not the result: standard output may be JSON for a machine."""
    errors.print(text, soft_wrap=True)


def complain(text: object, advice: str = "") -> None:
    """Say on standard error what is wrong and what to do about it.

    Args:
        text: What is wrong; it may name a command to call, and then says enough.
        advice: What to do otherwise.
    """
    said = Text.assemble(("muxjax: ", "bad"), str(text))
    if advice and "muxjax " not in str(text):
        said += Text(f" ({advice})", "aside")
    errors.print(said, soft_wrap=True)


def verdict(text: str, good: bool) -> Text:
    """A word in the colour of good or bad news; the word alone says it, too."""
    return Text(text, "good" if good else "bad")


def configuration_argument(robot: Robot, option: str, q_deg: Sequence[float]) -> np.ndarray:
    """A configuration [rad] typed as bending angle and azimuth of each segment [degrees].

    Raises:
        ValueError: Another count of numbers, one that is not finite, or bending that is negative or
            beyond a segment's limit.
    """
    count = 2 * robot.n_segments
    if len(q_deg) != count:
        raise ValueError(
            f"{option}: {robot.config.name} has {robot.n_segments} segments; give {count} numbers, "
            f"bending angle and azimuth of each [degrees], found {len(q_deg)}"
        )
    for place, value in enumerate(q_deg):
        segment, is_azimuth = place // 2 + 1, place % 2
        if not math.isfinite(value):
            what = "azimuth" if is_azimuth else "bending angle"
            raise ValueError(
                f"{option}: number {place + 1}, the {what} of segment {segment}, must be finite, "
                f"found {value:g}"
            )
        # The model has one name for each shape; a minus sign may as well be a slip of the hand.
        if value < 0 and not is_azimuth:
            raise ValueError(
                f"{option}: number {place + 1}, the bending angle of segment {segment}, must be at "
                f"least 0, found {value:g}; bend the other way: theta {-value:g}, phi + 180"
            )
    return check_configuration(robot, np.radians(np.asarray(q_deg, dtype=float)))


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
    """Scaled numbers side by side, without a minus before zero; "-" for what is not defined."""
    return "  ".join(
        "-" if math.isnan(v) else f"{round(scale * v, digits) + 0.0:.{digits}f}" for v in values
    )


def pose_document(pose: Any) -> dict[str, Any]:
    """A pose in every common notation."""
    turn = scipy.spatial.transform.Rotation.from_matrix(pose[:3, :3])
    return {
        "position_m": pose[:3, 3],
        "quaternion_wxyz": turn.as_quat(scalar_first=True, canonical=True),
        "rpy_deg": np.degrees(roll_pitch_yaw(pose[:3, :3])),
        "matrix": pose,
    }
