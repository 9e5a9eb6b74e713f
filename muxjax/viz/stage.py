"""One arm with its drive, drawn with viser."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from muxjax.robot import Robot
from muxjax.viz import drum
from muxjax.viz.playback import Moment
from muxjax.viz.scene import (
    Look,
    disc_mesh,
    guide_frames,
    guide_segments,
    segment_colour,
    strokes,
    tendon_points,
)

if TYPE_CHECKING:
    from viser import SceneApi

_DISC = 0.0026  # thickness of a drawn disc [m]
_BESIDE = (-0.21, -0.14, 0.0)  # of the drum from the arm's root, in its frame [m]
_TARGET = 0.14  # length of the target's arrows [m]
_NAME = 0.07  # what a servo's name takes beyond it [m]
_BLACK, _GREY, _RED = (25, 25, 25), (120, 120, 120), (190, 0, 30)


def quaternion(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Scalar first, as viser has them."""
    turns = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return np.asarray(turns.reshape(*rotation.shape[:-2], 4))


class Stage:
    """One arm and its drum under one node of the scene.

    Args:
        scene: Of the viser server.
        robot: The arm.
        name: Of the node.
        place: Where it stands: added to all positions [m].
    """

    def __init__(
        self, scene: SceneApi, robot: Robot, name: str, place: tuple[float, float, float]
    ) -> None:
        self._scene, self._robot, self._name = scene, robot, name
        base = np.asarray(robot.base)
        self.root = scene.add_frame(name, show_axes=False, position=place)
        frames = guide_frames(robot, np.zeros(2 * robot.n_segments))
        self._add_arm(frames)
        self._add_drum()
        self.title = scene.add_label(
            f"{name}/title",
            "",
            position=base[:3, 3] + 1.16 * float(np.sum(robot.length)) * base[:3, 2],
            anchor="bottom-center",
            visible=False,
        )

    def box(self) -> Float[np.ndarray, "16 3"]:
        """Corners around the straight arm with a target at its tool, and around the drum [m]."""
        robot = self._robot
        base, size = np.asarray(robot.base), float(np.sum(robot.length))
        tool = float(np.linalg.norm(robot.tool[:3, 3]))
        aside = float(robot.body_radius) + _TARGET / 2
        out = drum.RADIUS + drum.GAP + drum.SERVO[0] + _NAME
        local = [
            *product((-aside, aside), (-aside, aside), (0.0, size + tool + _TARGET)),
            *(
                np.array(corner) + _BESIDE
                for corner in product(
                    (-out, out),
                    (-drum.RADIUS, drum.RADIUS),
                    (-drum.LAYER / 2, self._top + drum.LAYER / 2),
                )
            ),
        ]
        return np.asarray(local) @ base[:3, :3].T + base[:3, 3]

    def _add_arm(self, frames: Float[np.ndarray, "D 4 4"]) -> None:
        robot, scene, name = self._robot, self._scene, self._name
        colours = np.array([segment_colour(int(s)) for s in guide_segments(robot)], np.uint8)
        colours[0] = _GREY
        self.discs = scene.add_batched_meshes_simple(
            f"{name}/discs",
            *disc_mesh(float(robot.body_radius), _DISC),
            batched_wxyzs=quaternion(frames[:, :3, :3]),
            batched_positions=frames[:, :3, 3],
            batched_colors=colours,
            lod="off",
            cast_shadow=False,
        )
        self._tendons = [
            scene.add_line_segments(
                f"{name}/tendons/{c + 1}", strokes(path, dashed=False), _GREY, thickness=0.001
            )
            for c, path in enumerate(tendon_points(robot, frames))
        ]
        self._axis = scene.add_line_segments(
            f"{name}/axis", strokes(frames[:, :3, 3], dashed=False), _BLACK, thickness=0.004
        )
        self._tool = scene.add_frame(
            f"{name}/tool", axes_length=0.045, axes_radius=0.002, origin_radius=0.004
        )

    def _add_drum(self) -> None:
        robot, scene = self._robot, self._scene
        name = f"{self._name}/drum"
        base = np.asarray(robot.base)
        centre = base[:3, 3] + base[:3, :3] @ np.array(_BESIDE)
        self.drum = scene.add_frame(
            name, show_axes=False, position=centre, wxyz=quaternion(base[:3, :3])
        )
        tall = drum.LAYER * robot.n_segments
        self._top = tall - drum.LAYER / 2 + 0.095  # of the servos' names
        for layer in range(robot.n_segments):
            scene.add_cylinder(
                f"{name}/layer{layer + 1}",
                drum.RADIUS - 0.012,
                0.8 * drum.LAYER,
                segment_colour(layer),
                position=(0.0, 0.0, drum.layer_height(robot, layer * robot.tendons_per_segment)),
                cast_shadow=False,
            )
        scene.add_cylinder(
            f"{name}/spindle",
            0.008,
            tall + 0.03,
            _GREY,
            position=(0.0, 0.0, (tall - drum.LAYER) / 2),
            cast_shadow=False,
        )
        places = drum.plugs(robot)
        # A disc's axis is z; a plug's points outwards.
        turns = [np.stack([np.cross(_UP, p.outward), _UP, p.outward], axis=-1) for p in places]
        scene.add_batched_meshes_simple(
            f"{name}/plugs",
            *disc_mesh(drum.PLUG, 0.012, 24),
            batched_wxyzs=quaternion(np.array(turns)),
            batched_positions=np.array([p.face - 0.006 * p.outward for p in places]),
            batched_colors=(235, 235, 235),
            lod="off",
            cast_shadow=False,
        )
        for number, plug in enumerate(places):
            scene.add_label(
                f"{name}/plug{number}",
                str(plug.tendon + 1),
                position=plug.face + 0.004 * plug.outward + (drum.PLUG + 0.007) * _UP,
                font_size_mode="scene",
                font_scene_height=0.016,
                anchor="center-center",
                depth_test=True,
            )
        hands = drum.needles(robot, np.zeros(robot.n_tendons))
        self._needles = scene.add_line_segments(f"{name}/hands", hands, _BLACK, thickness=0.003)
        self._shafts = scene.add_line_segments(
            f"{name}/shafts", _no_lines(), _BLACK, thickness=0.009, visible=False
        )
        self._crosses = scene.add_line_segments(
            f"{name}/crosses", _no_lines(), _RED, thickness=0.005, visible=False
        )
        self._servos, self._names = [], []
        for s in range(robot.tendons_per_segment):
            self._servos.append(
                scene.add_box(f"{name}/servo{s + 1}", _GREY, drum.SERVO, cast_shadow=False)
            )
            self._names.append(
                scene.add_label(
                    f"{name}/name{s + 1}",
                    f"servo {s + 1}",
                    font_size_mode="scene",
                    font_scene_height=0.018,
                    anchor="bottom-center",
                )
            )
        self._masts = scene.add_line_segments(f"{name}/masts", _no_lines(), _GREY, thickness=0.0015)

    def draw(self, moment: Moment, q: Float[np.ndarray, " dof"], looks: Sequence[Look]) -> None:
        """Show a moment.

        Args:
            moment: Drive and tendons.
            q: Configuration of the arm [rad].
            looks: Of the tendons.
        """
        robot = self._robot
        frames = guide_frames(robot, q)
        paths = tendon_points(robot, frames)
        self.discs.batched_positions = frames[:, :3, 3]
        self.discs.batched_wxyzs = quaternion(frames[:, :3, :3])
        self._axis.points = strokes(frames[:, :3, 3], dashed=False)
        tool = frames[-1] @ robot.tool
        self._tool.position, self._tool.wxyz = tool[:3, 3], quaternion(tool[:3, :3])
        for handle, path, look in zip(self._tendons, paths, looks, strict=True):
            handle.points = strokes(path, dashed=look.dashed)
            handle.colors = np.array(look.colour, np.uint8)
            handle.thickness = look.thickness
        self._draw_drum(moment)

    def _draw_drum(self, moment: Moment) -> None:
        robot = self._robot
        self._needles.points = drum.needles(robot, moment.displacements)
        axial = moment.axial
        known = axial is not None
        masts = np.zeros((len(self._servos), 2, 3))
        for s, (box, label) in enumerate(zip(self._servos, self._names, strict=True)):
            place = drum.servo_place(robot, s, 0.0 if axial is None else axial)
            box.position, box.wxyz = place.frame[:3, 3], quaternion(place.frame[:3, :3])
            lost = bool(moment.marks.lost[s])
            turns = bool(moment.slot) and bool(moment.moving[drum.facing(robot, moment.slot)[s]])
            box.color = (115, 115, 115) if lost else ((200, 70, 0) if turns else (70, 70, 70))
            why = ": not in the program" if s + 1 in moment.marks.left_out else ": failed"
            state = why if lost else (" turns" if turns else "")
            label.text = f"servo {s + 1}{state}"
            # Above the drum, on a mast, no name is hidden by it.
            label.position = place.frame[:3, 3] * [1, 1, 0] + (self._top + 0.002) * _UP
            masts[s, 0], masts[s, 1] = place.frame[:3, 3], label.position
            box.visible = label.visible = known
        self._masts.points, self._masts.visible = masts.astype(np.float32), known
        _set_lines(self._shafts, drum.shafts(robot, moment.slot, moment.marks.engaged))
        _set_lines(
            self._crosses,
            drum.crosses(robot, moment.marks.lost, axial) if axial is not None else _no_lines()[:0],
        )


_UP = np.array([0.0, 0.0, 1.0])


def _no_lines() -> Float[np.ndarray, "1 2 3"]:
    """A drawing of nothing: viser wants at least one piece."""
    return np.zeros((1, 2, 3))


def _set_lines(handle: Any, lines: Float[np.ndarray, "n 2 3"]) -> None:
    handle.visible = len(lines) > 0
    if len(lines):
        handle.points = lines
