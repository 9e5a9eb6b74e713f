"""The arm as shapes for a 3-D viewer: discs, tendons and tubes, in metres, as plain NumPy.

Nothing here knows the viewer. Every difference that a colour shows is shown by thickness or
dashes as well, for a person without colour vision and for grey print.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from muxjax.kinematics import backbone
from muxjax.robot import Robot

State = Literal["held", "moving", "wound in", "paid out"]

# Okabe-Ito colours; by lightness too they come in the order of the line's weight.
BY_STATE: dict[State, tuple[tuple[int, int, int], float, bool]] = {
    "held": ((190, 190, 190), 0.0013, False),
    "moving": ((200, 70, 0), 0.0042, False),
    "wound in": ((0, 80, 150), 0.0020, False),
    "paid out": ((225, 155, 0), 0.0020, True),
}
# Of shares from 0 to 1: lightness falls evenly (after matplotlib's cividis, turned round).
_SHADES = np.array(
    [[215, 195, 90], [165, 155, 110], [112, 114, 118], [60, 74, 108], [0, 34, 78]], dtype=float
)
# Okabe-Ito colours of segments as elsewhere, mixed with white, in the order of ``viz.style``.
_SEGMENTS = (
    (102, 170, 209),
    (240, 190, 153),
    (178, 226, 213),
    (240, 215, 229),
    (245, 216, 140),
    (204, 232, 250),
)
_AT_REST = 1e-4  # displacement from straight below which a tendon counts as held [m]


@dataclass(frozen=True)
class Look:
    """How a tendon is drawn.

    Attributes:
        colour: Red, green, blue, 0 to 255.
        thickness: Of the line [m].
        dashed: Whether the line has gaps.
    """

    colour: tuple[int, int, int]
    thickness: float
    dashed: bool


def segment_colour(segment: int) -> tuple[int, int, int]:
    """Pale colour of a segment, from 0, on which dark tendons stand out."""
    return _SEGMENTS[segment % len(_SEGMENTS)]


def guide_segments(robot: Robot) -> Int[np.ndarray, " D"]:
    """Segment, from 0, of each guide: the base first (with segment 0), then disc by disc."""
    counts = robot.n_discs.astype(int)
    return np.concatenate([[0], np.repeat(np.arange(robot.n_segments), counts)])


def guide_frames(robot: Robot, q: Float[np.ndarray, " dof"]) -> Float[np.ndarray, "D 4 4"]:
    """Frames of the base plate and of every disc, base to tip [m].

    The discs of a segment stand at equal arc lengths (M Eq. 1), xi_i of them, the last one at the
    segment's end.

    Args:
        robot: The arm.
        q: Configuration [rad].

    Raises:
        ValueError: See ``kinematics.backbone``.
    """
    counts = robot.n_discs.astype(int)
    along = {n: np.asarray(backbone(robot, q, n)) for n in sorted({int(n) for n in counts})}
    parts = [along[int(n)][i * n + 1 : (i + 1) * n + 1] for i, n in enumerate(counts)]
    first = next(iter(along.values()))[:1]
    return np.concatenate([first, *parts])


def tendon_points(
    robot: Robot, frames: Float[np.ndarray, "D 4 4"]
) -> list[Float[np.ndarray, "_ 3"]]:
    """Where each tendon passes the guides, from the base to the last disc of its segment [m].

    In segment n tendon j of segment i runs at the azimuth psi[n, i, j] on the circle of radius
    r_a. Of a tendon that keeps its azimuth the straight pieces add up to M Eq. 6, which has xi
    chords a segment; that of another one has its step between two segments in no chord.

    Args:
        robot: The arm.
        frames: As ``guide_frames`` gives them.
    """
    of = guide_segments(robot)
    paths = []
    for c in range(robot.n_tendons):
        segment, j = divmod(c, robot.tendons_per_segment)
        crossed = of[of <= segment]
        azimuth = robot.tendon_azimuth[crossed, segment, j]
        holes = float(robot.tendon_radius) * np.stack(
            [np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=-1
        )
        own = frames[: len(crossed)]
        paths.append(own[:, :3, 3] + np.einsum("pij,pj->pi", own[:, :3, :3], holes))
    return paths


def tendon_states(
    displacements: Float[np.ndarray, " SJ"], moving: Bool[np.ndarray, " SJ"]
) -> tuple[State, ...]:
    """What each tendon does: it moves, or it is held where it is wound in, paid out, or straight.

    Args:
        displacements: From straight [m]; negative = wound in.
        moving: Which ones move now.
    """
    found: list[State] = []
    for length, moves in zip(displacements, moving, strict=True):
        if moves:
            found.append("moving")
        elif abs(length) < _AT_REST:
            found.append("held")
        else:
            found.append("wound in" if length < 0 else "paid out")
    return tuple(found)


def looks_by_state(states: tuple[State, ...]) -> tuple[Look, ...]:
    """How tendons in these states are drawn."""
    return tuple(Look(*BY_STATE[state]) for state in states)


def looks_by_tension(
    tension: Float[np.ndarray, " SJ"], most: float, moving: Bool[np.ndarray, " SJ"]
) -> tuple[Look, ...]:
    """How tendons under tension are drawn: pale and thin when slack, dark and thick when tight.

    Args:
        tension: Of each tendon [N].
        most: Tension of the darkest colour [N].
        moving: Which ones move now; those have gaps.
    """
    share = np.clip(np.nan_to_num(tension) / most if most > 0 else 0 * tension, 0.0, 1.0)
    return tuple(
        Look((int(r), int(g), int(b)), 0.0010 + 0.0026 * float(s), bool(moves))
        for s, (r, g, b), moves in zip(share, shades(share), moving, strict=True)
    )


def shades(shares: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours of shares from 0, pale, to 1, dark."""
    stops = np.linspace(0.0, 1.0, len(_SHADES))
    return np.stack([np.interp(shares, stops, c) for c in _SHADES.T], axis=-1).astype(np.uint8)


def strokes(points: Float[np.ndarray, "n 3"], *, dashed: bool) -> Float[np.ndarray, "m 2 3"]:
    """A polyline as straight pieces, each with a gap in its second half if ``dashed``."""
    begin, end = points[:-1], points[1:]
    if dashed:
        end = begin + 0.55 * (end - begin)
    return np.stack([begin, end], axis=1)


def disc_mesh(
    radius: float, thickness: float, sides: int = 36
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """A flat cylinder about z, its middle at the origin: vertices [m] and triangles."""
    turn = np.arange(sides) * 2 * np.pi / sides
    rim = radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    half = np.full((sides, 1), thickness / 2)
    centre = np.array([[0.0, 0.0, -thickness / 2], [0.0, 0.0, thickness / 2]])
    vertices = np.concatenate([np.hstack([rim, -half]), np.hstack([rim, half]), centre])
    k = np.arange(sides)
    after = (k + 1) % sides
    low, high = 2 * sides, 2 * sides + 1
    faces = np.concatenate(
        [
            np.stack([k, after, k + sides], axis=-1),
            np.stack([after, after + sides, k + sides], axis=-1),
            np.stack([after, k, np.full(sides, low)], axis=-1),
            np.stack([k + sides, after + sides, np.full(sides, high)], axis=-1),
        ]
    )
    return vertices, faces


def tube_mesh(
    line: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, " n"] | float, sides: int = 16
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """The surface around a line, open at its ends: vertices [m] and triangles facing out.

    Args:
        line: Points, no two neighbours at one place [m].
        radius: Around each point [m].
        sides: Of the cross-section.
    """
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), len(line))
    along = np.diff(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    tangents = np.concatenate([along[:1], along[:-1] + along[1:], along[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    # A side direction carried along the line, so that the surface does not twist.
    side = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    turn = np.arange(sides) * 2 * np.pi / sides
    rings = []
    for point, tangent, r in zip(line, tangents, radii, strict=True):
        side = side - (side @ tangent) * tangent
        side /= np.linalg.norm(side)
        other = np.cross(tangent, side)
        rings.append(point + r * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other))
    k = np.arange(sides)
    after = (k + 1) % sides
    faces = [
        np.concatenate(
            [
                np.stack([a + k, a + after, a + sides + k], axis=-1),
                np.stack([a + after, a + sides + after, a + sides + k], axis=-1),
            ]
        )
        for a in range(0, sides * (len(line) - 1), sides)
    ]
    return np.concatenate(rings), np.concatenate(faces)
