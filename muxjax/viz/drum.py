"""The drive as a schematic drum: plugs, servos, clutches and winding wheels (MODEL.md section 4).

The real module is compact; here it is drawn so that one sees which servo meets which tendon. Plugs
sit around a drum, those of a segment in one layer. The servos stand outside, 360 / J degrees apart,
and go round together: at axial position a servo s is at the angle 2 pi (a / A + s / J), where the
plug of the tendon that the robot's axial map names stands. All lengths are of the drawing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from muxjax.robot import Robot

RADIUS = 0.062  # of the drum, where the plugs end [m]
LAYER = 0.052  # height of a layer [m]
GAP = 0.018  # between a plug and the tip of the servo that faces it [m]
PLUG = 0.015  # radius of a plug [m]
SERVO = (0.048, 0.030, 0.030)  # box: outwards, sideways, up [m]


@dataclass(frozen=True)
class Plug:
    """A place at the drum where a servo can meet a tendon.

    Attributes:
        tendon: From 0.
        angle: About the drum's axis [rad], in [0, 2 pi).
        height: Of its layer [m].
    """

    tendon: int
    angle: float
    height: float

    @property
    def outward(self) -> Float[np.ndarray, "3"]:
        """Unit vector away from the drum's axis."""
        return np.array([np.cos(self.angle), np.sin(self.angle), 0.0])

    @property
    def face(self) -> Float[np.ndarray, "3"]:
        """Middle of the plug's outer face [m]."""
        return RADIUS * self.outward + np.array([0.0, 0.0, self.height])


@dataclass(frozen=True, eq=False)
class ServoPlace:
    """Where a servo stands in the drawing.

    Attributes:
        frame: Its middle; x points to the drum's axis, z up [m].
        tip: End of its shaft, towards the drum [m].
    """

    frame: Float[np.ndarray, "4 4"]
    tip: Float[np.ndarray, "3"]


def layer_height(robot: Robot, tendon: int) -> float:
    """Height of a tendon's layer [m]; segment 1 on top, nearest to the arm."""
    return LAYER * (robot.n_segments - 1 - tendon // robot.tendons_per_segment)


def servo_angle(robot: Robot, servo: int, axial: float) -> float:
    """Angle of a servo, from 0, about the drum's axis [rad], at a position from 0."""
    n_axial, n_servos = robot.axial_map.shape
    return 2 * np.pi * (axial / n_axial + servo / n_servos)


def plugs(robot: Robot) -> tuple[Plug, ...]:
    """Every plug once, by tendon.

    The rule of M III-A gives one plug a tendon; a map of one's own may need several.
    """
    n_axial, n_servos = robot.axial_map.shape
    steps = n_axial * n_servos  # every angle is a whole number of these
    found = {
        (int(robot.axial_map[a, s]), (a * n_servos + s * n_axial) % steps)
        for a in range(n_axial)
        for s in range(n_servos)
    }
    return tuple(
        Plug(tendon, 2 * np.pi * step / steps, layer_height(robot, tendon))
        for tendon, step in sorted(found)
    )


def servo_place(robot: Robot, servo: int, axial: float) -> ServoPlace:
    """Where a servo, from 0, stands at an axial position; between two, on the way."""
    n_axial = len(robot.axial_map)
    below = int(np.floor(axial))
    share = axial - below
    heights = [
        layer_height(robot, int(robot.axial_map[a % n_axial, servo])) for a in (below, below + 1)
    ]
    height = (1 - share) * heights[0] + share * heights[1]
    angle = servo_angle(robot, servo, axial)
    outward = np.array([np.cos(angle), np.sin(angle), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    tip = (RADIUS + GAP) * outward + height * up
    frame = np.eye(4)
    frame[:3, :3] = np.stack([-outward, np.cross(up, -outward), up], axis=-1)
    frame[:3, 3] = tip + (SERVO[0] / 2) * outward
    return ServoPlace(frame, tip)


def facing(robot: Robot, slot: int) -> tuple[int, ...]:
    """Tendon, from 0, that each servo faces at an axial position from 1."""
    return tuple(int(c) for c in robot.axial_map[slot - 1])


def shafts(robot: Robot, slot: int, engaged: Bool[np.ndarray, " SJ"]) -> Float[np.ndarray, "n 2 3"]:
    """The bridges of engaged clutches, from a servo's tip to its plug [m]; none between slots."""
    if not slot:
        return np.zeros((0, 2, 3))
    inward = np.array([RADIUS / (RADIUS + GAP), RADIUS / (RADIUS + GAP), 1.0])
    tips = [
        servo_place(robot, servo, float(slot - 1)).tip
        for servo, tendon in enumerate(facing(robot, slot))
        if engaged[tendon]
    ]
    return np.array([[tip, inward * tip] for tip in tips]).reshape(-1, 2, 3)


def crosses(robot: Robot, lost: Bool[np.ndarray, " J"], axial: float) -> Float[np.ndarray, "n 2 3"]:
    """An X through each failed servo, on its outer face and on top [m]."""
    x, y, z = (0.62 * size for size in SERVO)
    diagonals = np.array(
        [
            [(-x, -y, z), (x, y, z)],
            [(-x, y, z), (x, -y, z)],
            [(-x, -y, -z), (-x, y, z)],
            [(-x, y, -z), (-x, -y, z)],
        ]
    )
    frames = [servo_place(robot, int(servo), axial).frame for servo in np.flatnonzero(lost)]
    lines = [diagonals @ frame[:3, :3].T + frame[:3, 3] for frame in frames]
    return np.array(lines).reshape(-1, 2, 3)


def needles(robot: Robot, displacements: Float[np.ndarray, " SJ"]) -> Float[np.ndarray, "P 2 3"]:
    """A hand on every plug's face that turns as its winding wheel does, by dl / r_w [m]."""
    lines = []
    for plug in plugs(robot):
        turned = float(displacements[plug.tendon]) / float(robot.wheel_radius)
        aside = np.cross([0.0, 0.0, 1.0], plug.outward)
        hand = np.cos(turned) * np.array([0.0, 0.0, 1.0]) + np.sin(turned) * aside
        centre = plug.face + 0.001 * plug.outward
        lines.append([centre, centre + 0.9 * PLUG * hand])
    return np.array(lines)
