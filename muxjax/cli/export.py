"""``muxjax export``: programs, plans and recorded runs for other software."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from muxjax.cli.output import console, notice, print_json
from muxjax.hardware.journal import is_journal
from muxjax.metrics.program import timeline
from muxjax.program_file import save_program
from muxjax.recording import (
    Recording,
    logged_recording,
    program_recording,
    read_log,
    read_program,
    save_mcap,
)
from muxjax.recording.mcap import SCHEMAS
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import Program
from muxjax.trajectory_file import Samples, columns, sample, save_trajectory


def export(
    source: Annotated[Path, tyro.conf.Positional],
    out: Path,
    rate_hz: float = 50.0,
    per_segment: int = 6,
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """Write how a program, a plan or a recorded run moves the arm; or the program of a plan.

    A trajectory, as .csv or .npz, has tendons, bending and the tool over time, in SI units named in
    each column: time_s, tendon_1_m ..., theta_1_rad, phi_1_rad ..., x_m, y_m, z_m, qw, qx, qy, qz.
    An .mcap file, for Foxglove and PlotJuggler, has them as topics, with joint states named like
    the URDF's joints, the drum, the servos and the clutches. Times are those of M Eq. 14, or those
    of the log.

    Example: muxjax export program.json --out trajectory.csv

    Example: muxjax export program.json --out trajectory.npz --rate-hz 200

    Example: muxjax export run.log --out run.mcap

    Example: muxjax export plan.json --out program.json

    Args:
        source: Program (muxjax plan --out), plan (muxjax plan --save-plan), or the frames of a run
            (muxjax run --log), a file that ends in .log.
        out: File to write: a trajectory as .csv or .npz, topics as .mcap, a program as .json.
        rate_hz: Samples a second [Hz]; the end itself is one more.
        per_segment: Two-axis joints a segment of the joint states, as of muxjax urdf.
        robot: Shipped robot or path of a YAML file; it must be that of the source.
        json: Print what was written as JSON.
    """
    if out.suffix not in _ENDINGS:
        raise ValueError(f"--out: {out} must end in one of {', '.join(_ENDINGS)}")
    arm = load_robot(robot)
    document: dict[str, object]
    if source.suffix == ".log":
        if out.suffix == ".json":
            raise ValueError(f"--out: a run is no program; {out} must end in .csv, .npz or .mcap")
        document, text = _write_run(arm, source, out, rate_hz, per_segment)
    elif is_journal(source):
        raise ValueError(
            f"{source}: is the journal of a run and has no clock; export takes the run's frames, "
            "which muxjax run --log FILE.log writes"
        )
    else:
        document, text = _write_program(arm, read_program(arm, source), out, rate_hz, per_segment)
    if json:
        print_json({"robot": arm.config.name, "file": str(out), **document})
    else:
        console.print(text)
    return 0


_ENDINGS = (".csv", ".npz", ".mcap", ".json")


def _write_program(
    arm: Robot, program: Program, out: Path, rate_hz: float, per_segment: int
) -> tuple[dict[str, object], str]:
    if out.suffix == ".json":
        save_program(program, out)
        count = len(program.instructions)
        return {"instructions": count}, f"program of {count} instructions written to {out}"
    if out.suffix == ".mcap":
        return _write_mcap(arm, program_recording(arm, program, rate_hz), out, per_segment)
    return _write_samples(sample(arm, timeline(arm, program), rate_hz), out)


def _write_run(
    arm: Robot, source: Path, out: Path, rate_hz: float, per_segment: int
) -> tuple[dict[str, object], str]:
    run = read_log(arm, source)
    if run.refused:
        notice(f"{source}: {run.refused} frames left out that were damaged or not the board's")
    if out.suffix == ".mcap":
        return _write_mcap(arm, logged_recording(arm, run, rate_hz), out, per_segment)
    return _write_samples(sample(arm, run.trajectory, rate_hz), out)


def _write_samples(samples: Samples, out: Path) -> tuple[dict[str, object], str]:
    save_trajectory(samples, out)
    count, end = len(samples.time_s), float(samples.time_s[-1])
    document = {"samples": count, "duration_s": end, "columns": list(columns(samples))}
    return document, f"{count} samples of {end:.2f} s written to {out}"


def _write_mcap(
    arm: Robot, recording: Recording, out: Path, per_segment: int
) -> tuple[dict[str, object], str]:
    count = save_mcap(arm, recording, out, per_segment)
    end = float(recording.samples.time_s[-1])
    document = {"messages": count, "duration_s": end, "topics": list(SCHEMAS)}
    return document, f"{count} messages of {len(SCHEMAS)} topics, {end:.2f} s, written to {out}"
