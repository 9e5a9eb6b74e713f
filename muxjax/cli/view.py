"""``muxjax view``: the arm, its drive and what they do, in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from muxjax.cli.output import configuration_argument, console, notice
from muxjax.cli.plans import Method
from muxjax.cli.poses import Quaternion, Xyz, pose_argument
from muxjax.collision import load_world
from muxjax.robot import Robot, load_robot
from muxjax.workspace import load_sweep

if TYPE_CHECKING:
    from muxjax.viz.desk import Desk
    from muxjax.viz.viewer import Viewer

_CLOUD_SAMPLES = 20_000
_PIXELS = 200, 4000  # least and most of a picture's sides


def view(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    q_deg: tuple[float, ...] | None = None,
    xyz_mm: Xyz | None = None,
    rpy_deg: Xyz | None = None,
    quat: Quaternion | None = None,
    servos: tuple[int, ...] | None = None,
    method: Method = "exact",
    beside: Method | None = None,
    preset: str = "paper",
    world: str | None = None,
    sweep: Path | None = None,
    cloud: bool = False,
    colour: Literal["state", "tension"] = "state",
    robot: str = "muxarm",
    host: str = "127.0.0.1",
    port: int = 8080,
    screenshot: Path | None = None,
    size: tuple[int, int] = (1280, 800),
    tab: Literal["Arm", "Plan", "Play", "Show"] = "Arm",
    at_s: float = 0.0,
) -> int:
    """Look at the arm in a browser: bend it, drag a target, plan to it, play plans and runs.

    Serves a page until Ctrl-C. With a target, the plan to it is made at once; files are put on
    the timeline, the first two side by side.

    Example: muxjax view

    Example: muxjax view program.json run.log

    Example: muxjax view --xyz-mm 152.25 0 413.777 --rpy-deg 0 25 0 --beside reverse --servos 1

    Example: muxjax view --world cabinet --cloud --screenshot arm.png

    Args:
        files: Programs (muxjax plan --out), plans (--save-plan), trajectories (muxjax export),
            journals and logs of runs (muxjax run --journal, --log).
        q_deg: Bending angle (not negative) and azimuth of each segment at first [degrees]; straight
            by default.
        xyz_mm: Target of the tool in the world [mm].
        rpy_deg: Its roll, pitch, yaw [degrees]; upright by default.
        quat: Its orientation as a quaternion w x y z instead.
        servos: Available servos; the others are marked as failed. All by default.
        method: Planner chosen first.
        beside: Planner whose plan is shown beside it.
        preset: Weights of the planners' cost: paper, fastest, no-overshoot, gentle, or a YAML file.
        world: Shipped world or path of a YAML file, drawn, of which plans must be clear.
        sweep: Result of muxjax sweep (.npz), drawn as a cloud shaded by dexterity.
        cloud: Draw the workspace as a cloud of random samples instead.
        colour: What the tendons' colour and weight say: state or tension.
        robot: Shipped robot or path of a YAML file.
        host: Address to serve at; 0.0.0.0 lets other machines look, and lead the arm.
        port: Likewise; 0 takes any free one.
        screenshot: Save a picture as PNG with a browser without a window, and end.
        size: Of the picture [pixels].
        tab: Of the panel, in the picture.
        at_s: Time of the timeline, in the picture [s].
    """
    if xyz_mm is None and (rpy_deg is not None or quat is not None):
        raise ValueError("view: only --xyz-mm takes --rpy-deg or --quat")
    if beside is not None and xyz_mm is None:
        raise ValueError("view: --beside is of the plan to --xyz-mm")
    if screenshot is not None and screenshot.suffix != ".png":
        raise ValueError(f"screenshot: must end in .png, found {screenshot}")
    if not all(_PIXELS[0] <= pixels <= _PIXELS[1] for pixels in size):
        raise ValueError(f"size: must be {_PIXELS[0]} to {_PIXELS[1]} pixels, found {size}")
    make_viewer = _viewer_class()
    if screenshot is not None:
        from muxjax.viz.screenshot import find_browser, take_screenshot

        find_browser()  # what is missing is said before any work
    arm = load_robot(robot)
    desk = _desk(arm, files, q_deg, servos, preset, world)
    points = _cloud(arm, sweep, cloud)
    viewer = make_viewer(
        desk,
        host=host,
        port=0 if screenshot is not None else port,
        method=method,
        colour=colour,
        cloud=points,
    )
    refusal = ""
    try:
        names = list(desk.tracks)
        if xyz_mm is not None:
            refusal = viewer.aim(pose_argument(xyz_mm, rpy_deg, quat), beside)
            if refusal:
                notice(f"muxjax: {refusal}")  # the page says so too, and can mend it
        elif names:
            viewer.show_tracks(names[:2])
        if at_s > viewer.duration_s:
            notice(f"muxjax: --at-s {at_s:g}: the timeline ends at {viewer.duration_s:.2f} s")
        viewer.seek(at_s)
        if screenshot is not None:
            take_screenshot(viewer, screenshot, size, tab)
            console.print(f"{screenshot} written")
            return 1 if refusal else 0
        console.print(f"{viewer.url}   (Ctrl-C ends)")
        viewer.run()
    except KeyboardInterrupt:
        notice("viewer closed")
    finally:
        viewer.stop()
    return 0


def _desk(
    arm: Robot,
    files: tuple[Path, ...],
    q_deg: tuple[float, ...] | None,
    servos: tuple[int, ...] | None,
    preset: str,
    world: str | None,
) -> Desk:
    from muxjax.planning.problem import preset_weights
    from muxjax.viz.desk import Desk
    from muxjax.viz.recorded import read_track

    preset_weights(preset)  # a wrong name is refused before any work
    desk = Desk(arm, None if world is None else load_world(world), preset)
    for path in files:
        track = read_track(arm, path)
        desk.tracks[_unused(track.name, desk.tracks)] = track
    if q_deg is not None:
        desk.set_q_deg(np.degrees(configuration_argument(arm, "--q-deg", q_deg)))
    every = tuple(range(1, arm.tendons_per_segment + 1))
    for servo in servos or every:
        if servo not in every:
            raise ValueError(f"servos: the robot has servos 1 to {every[-1]}, found {servo}")
    desk.failed = ~np.isin(every, servos or every)
    return desk


def _unused(name: str, taken: dict[str, Any]) -> str:
    """The name, numbered if two files have the same."""
    count = sum(1 for other in taken if other == name or other.startswith(f"{name} ("))
    return f"{name} ({count + 1})" if count else name


def _cloud(arm: Robot, sweep: Path | None, sampled: bool) -> tuple[np.ndarray, np.ndarray] | None:
    from muxjax.viz.obstacles import sampled_cloud, sweep_cloud

    if sweep is not None:
        if sampled:
            raise ValueError("view: give either --sweep or --cloud")
        points, dexterity = sweep_cloud(arm, load_sweep(sweep))
        return points, dexterity / max(float(dexterity.max()), 1e-9)  # the best cell is darkest
    if not sampled:
        return None
    points = sampled_cloud(arm, _CLOUD_SAMPLES)
    return points, np.full(len(points), 0.3)


def _viewer_class() -> type[Viewer]:
    try:
        from muxjax.viz.viewer import Viewer
    except ImportError as error:
        raise ValueError(
            f"view: needs {error.name}, which is not installed: pip install 'muxjax[viz]'"
        ) from None
    return Viewer
