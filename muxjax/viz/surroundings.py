"""What stands around the arm in the scene: light, cameras, obstacles, workspace and solutions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from muxjax.collision import World
from muxjax.robot import Robot
from muxjax.viz.obstacles import sampled_points, solids
from muxjax.viz.scene import guide_frames, shades, tube_mesh

if TYPE_CHECKING:
    from viser import SceneApi, ViserServer

_OBSTACLE = {"round": 0.75, "box": 0.6, "plane": 0.25, "tube": 0.22}  # opacity
_FIELD = float(np.radians(45))  # from the page's bottom to its top
_ASPECT = 1.55  # width over height of the narrowest page that shows all
_MARGIN = 0.96  # share of half the page's height, and of half its width on the left, that is used
_FREE = 0.38  # share of half its width on the right, before the panel


def add_light(scene: SceneApi) -> None:
    """Even light without reflections or shadows: readable, and quick without a GPU too."""
    scene.configure_environment_map(None)
    scene.configure_default_lights(False)
    scene.add_light_ambient("/light/ambient", intensity=1.9)
    places = ((-1.0, -2.0, 3.0), (2.0, -1.0, 0.5), (0.0, 3.0, 1.0))
    for number, (place, intensity) in enumerate(zip(places, (1.3, 0.6, 0.6), strict=True)):
        scene.add_light_directional(f"/light/{number}", position=place, intensity=intensity)


def place_cameras(
    server: ViserServer, robot: Robot, beside: float, box: Float[np.ndarray, "n 3"]
) -> None:
    """Have everybody look at the arm, or at two of them that stand ``beside`` each other [m].

    Args:
        server: Whose browsers look.
        robot: The arm.
        beside: From the first arm to the second; 0 for one arm.
        box: Points that are to be in sight around the first arm [m].
    """
    points = np.concatenate([box, box + np.array([beside, 0.0, 0.0])])
    place, onward = view_of(points)
    base, size = np.asarray(robot.base), float(np.sum(robot.length))
    middle = base[:3, 3] + 0.41 * size * base[:3, 2] + np.array([0.5 * beside, 0.0, 0.0])
    look = place + onward * ((middle - place) @ onward)  # people turn the scene about it
    cameras: list[Any] = [client.camera for client in server.get_clients().values()]
    for camera in (server.initial_camera, *cameras):
        camera.position, camera.look_at = place, look
        camera.fov = _FIELD


def view_of(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Nearest place from which points are in sight [m], and the unit vector of the view.

    In sight means: on a page of ``_ASPECT`` or wider, beside the panel that covers its right.
    """
    onward = np.array([0.28, 0.9, -0.36])
    onward /= np.linalg.norm(onward)
    right = np.cross(onward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(right, onward), onward])  # to the right, up, away
    x, y, z = turn @ points.T
    tangent = np.tan(_FIELD / 2)
    up = _MARGIN * tangent
    left, free = _ASPECT * up, _ASPECT * _FREE * tangent
    # A point at depth z - d of a camera at (a, b, d) is in sight if
    # -left (z - d) <= x - a <= free (z - d) and |y - b| <= up (z - d).
    least_a, most_a = np.max(x - free * z), np.min(x + left * z)
    least_b, most_b = np.max(y - up * z), np.min(y + up * z)
    d = min((most_a - least_a) / (left + free), (most_b - least_b) / (2 * up))
    a = 0.5 * (least_a + free * d + most_a - left * d)
    b = 0.5 * (least_b + most_b)
    return turn.T @ np.array([a, b, d]), onward


def add_grid(scene: SceneApi, robot: Robot) -> None:
    """A floor of squares of 100 mm, a little below the arm's root."""
    root = np.asarray(robot.base)[:3, 3]
    floor = root - np.array([0.0, 0.0, 0.06])
    scene.add_grid("/grid", 1.6, 1.6, cell_size=0.1, section_size=0.5, position=floor)


def add_cloud(
    scene: SceneApi, name: str, points: Float[np.ndarray, "n 3"], shares: Float[np.ndarray, " n"]
) -> None:
    """Draw a workspace: points [m], darker the nearer their share is to 1."""
    scene.add_point_cloud(name, points, shades(shares), point_size=0.0018)


def add_world(scene: SceneApi, robot: Robot, world: World, name: str) -> None:
    """Draw a world's obstacles, pale enough to see the arm through them."""
    for number, solid in enumerate(solids(world, np.asarray(robot.base)[:3, 3]), start=1):
        scene.add_mesh_simple(
            f"{name}/{solid.kind}{number}",
            solid.vertices,
            solid.faces,
            color=(130, 130, 140),
            opacity=_OBSTACLE[solid.kind],
            side="double",
            flat_shading=solid.kind == "box",
            cast_shadow=False,
            receive_shadow=False,
        )
    points = sampled_points(world)
    if len(points):
        scene.add_point_cloud(f"{name}/sampled", points, (110, 110, 120), point_size=0.004)


def add_ghosts(
    scene: SceneApi,
    robot: Robot,
    solutions: Float[np.ndarray, "K dof"],
    chosen: int,
    on_click: Callable[[int], None],
) -> list[Any]:
    """Draw configurations as pale tubes, the chosen one darker and thicker, each with its number.

    Args:
        scene: Of the viser server.
        robot: The arm.
        solutions: Configurations [rad].
        chosen: Which one is darker, from 0.
        on_click: Called with the number, from 0, of one that was clicked.

    Returns:
        What was drawn, to be removed.
    """
    drawn: list[Any] = []
    for k, q in enumerate(solutions):
        line = guide_frames(robot, q)[:, :3, 3]
        mine = k == chosen
        tube = scene.add_mesh_simple(
            f"/ghosts/{k + 1}",
            *tube_mesh(line, 0.011 if mine else 0.007),
            color=(0, 110, 80) if mine else (90, 90, 90),
            opacity=0.5 if mine else 0.3,
            cast_shadow=False,
        )
        tube.on_click(partial(_clicked, on_click, k))
        # Solutions meet at the tip and at the root: the numbers stand in between, spread along it.
        share = 0.3 + 0.5 * (k + 0.5) / len(solutions)
        text = f"solution {k + 1} (chosen)" if mine else str(k + 1)
        scene.add_label(  # goes with its tube
            f"/ghosts/{k + 1}/name", text, position=line[round(share * (len(line) - 1))]
        )
        drawn.append(tube)
    return drawn


def _clicked(on_click: Callable[[int], None], k: int, _: Any) -> None:
    on_click(k)
