"""``muxjax task``: a whole mission, planned, executed on the virtual board, and drawn."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.table import Table

from muxjax.cli.output import console, print_json, verdict
from muxjax.hardware import LockstepLink
from muxjax.pipeline.missions.files import MissionConfig, load_mission
from muxjax.pipeline.missions.plan import Planner
from muxjax.pipeline.missions.run import StageRun, run_mission
from muxjax.pipeline.swept import at_base
from muxjax.planning import PlanningError
from muxjax.planning.problem import preset_weights
from muxjax.robot import Robot, load_robot

_STREAM_DIVIDER = 10


def task(
    mission: Annotated[str, tyro.conf.Positional],
    servos: tuple[int, ...] | None = None,
    robot: str = "muxarm",
    preset: str = "fastest",
    physics: str = "ideal",
    seed: int = 0,
    out: Path = Path("out/task"),
    pictures: bool = True,
    json: bool = False,
) -> int:
    """A mission among obstacles, stage by stage: plan, run on the virtual board, draw.

    Example: muxjax task cabinet --servos 1 2

    Args:
        mission: Shipped mission (cabinet, pipe) or path of a YAML file.
        servos: Available servos; all by default.
        robot: Shipped robot or path of a YAML file.
        preset: Weights of the planner's cost: paper, fastest, no-overshoot, gentle, or a YAML file.
        physics: Physics of the virtual board.
        seed: Of the in-between shapes, where direct plans are blocked.
        out: Folder for the pictures.
        pictures: Draw them.
        json: Print JSON in SI units.
    """
    arm, scene = load_robot(robot), load_mission(mission)
    preset_weights(preset)  # a wrong name is refused before any work
    available = servos or tuple(range(1, arm.tendons_per_segment + 1))
    planner = Planner(arm, scene, servos=available, preset=preset, seed=seed)
    link = LockstepLink(arm, physics, stream_divider=_STREAM_DIVIDER)
    began, done, refusal = time.perf_counter(), list[StageRun](), ""
    try:
        for stage in run_mission(planner, link):
            done.append(stage)
    except PlanningError as error:
        refusal = str(error)
    refusal = refusal or next((d.failure for d in done if d.failure), "")
    drawn = _draw(arm, scene, done, available, out) if pictures and done else []
    if json:
        print_json(_document(scene, available, done, refusal, drawn))
    else:
        _print(scene, done, drawn, time.perf_counter() - began)
        if refusal:
            console.print(verdict(f"not completed: {refusal}", False))
    return 1 if refusal else 0


def _print(mission: MissionConfig, done: list[StageRun], drawn: list[Path], seconds: float) -> None:
    table = Table(
        "step",
        "stage",
        "instructions",
        "T [s]",
        "board [s]",
        "planned [mm]",
        "true [mm]",
        "tool [mm]",
        title=f"{mission.name}: least clearance by stage, margin {1e3 * mission.margin_m:.1f} mm",
        title_justify="left",
    )
    for item in done:
        run = item.run
        table.add_row(
            item.stage.step,
            item.stage.kind + (" (again)" if item.replanned else ""),
            str(item.stage.stops) if run else "",
            f"{item.stage.time_s:.1f}" if run else "",
            f"{run.duration_s:.1f}" if run else "",
            f"{1e3 * item.stage.clearance:.1f}",
            f"{1e3 * item.clearance:.1f}",
            f"{1e3 * item.tool_error:.3f}",
        )
    console.print(table)
    moved = [item for item in done if item.run]
    console.print(
        f"{len(done)} stages, {len(moved)} of them tendons: "
        f"{sum(i.stage.stops for i in moved)} instructions, "
        f"{sum(i.run.duration_s for i in moved if i.run):.0f} s on the board's clock; least "
        f"clearance {1e3 * min((i.clearance for i in done), default=np.nan):.1f} mm; "
        f"done in {seconds:.0f} s" + (f"; pictures: {', '.join(map(str, drawn))}" if drawn else "")
    )


def _document(
    mission: MissionConfig,
    servos: tuple[int, ...],
    done: list[StageRun],
    refusal: str,
    drawn: list[Path],
) -> dict[str, Any]:
    return {
        "mission": mission.name,
        "servos": servos,
        "completed": not refusal,
        "reason": refusal or "completed",
        "margin_m": mission.margin_m,
        "least_clearance_m": min((item.clearance for item in done), default=float("nan")),
        "pictures": [str(path) for path in drawn],
        "stages": [
            {
                "step": item.stage.step,
                "kind": item.stage.kind,
                "instructions": item.stage.stops,
                "time_s": item.stage.time_s,
                "board_s": item.run.duration_s if item.run else 0.0,
                "planned_clearance_m": item.stage.clearance,
                "clearance_m": item.clearance,
                "tool_error_m": item.tool_error,
                "replanned": item.replanned,
                "base": item.scene.base,
                "displacements_m": item.scene.displacements,
            }
            for item in done
        ],
    }


def _draw(
    robot: Robot, mission: MissionConfig, done: list[StageRun], servos: tuple[int, ...], out: Path
) -> list[Path]:
    try:
        from muxjax.viz import missions as viz
    except ImportError:
        console.print("no pictures: they need matplotlib, pip install 'muxjax[viz]'")
        return []

    def shot(item: StageRun, title: str, displacements: Any, base: Any) -> Any:
        return viz.Snapshot(title, at_base(robot, base), displacements, item.world)

    ends = [i for i, n in zip(done, [*done[1:], None], strict=True) if _ends_step(i, n)]
    insides = [i for i in done if i.stage.kind == "tendons" and i not in ends]
    chosen = [i for i in done if i in ends or i in insides[2::5]]
    panels = [shot(i, i.stage.step, i.points[-1], i.scene.base) for i in chosen]
    bars = [viz.Bar(i.stage.step, i.stage.kind, i.clearance) for i in done]
    names = " ".join(map(str, servos))
    tubes = bool(mission.tubes)
    pictures = [
        viz.draw_mission(
            panels,
            bars,
            mission.margin_m,
            f"{mission.name}, servos {names}",
            out / f"{mission.name}.png",
            views=((0, 2),) if tubes else ((0, 2), (1, 2)),
        )
    ]
    frames = []
    for item in done:
        if item.stage.kind == "tendons":
            some = item.points[:: max(1, len(item.points) // 3)]
            frames += [shot(item, item.stage.step, p, item.scene.base) for p in some]
        frames.append(shot(item, item.stage.step, item.points[-1], item.scene.base))
    pictures.append(viz.animate_mission(frames, out / f"{mission.name}.gif"))
    return pictures


def _ends_step(item: StageRun, following: StageRun | None) -> bool:
    return following is None or following.stage.step != item.stage.step
