"""Deploy: rehearse, run, be interrupted, go on, lose a servo. Shown by docs/tutorials/deploy.md.

It writes program.json and run.journal into the folder out/deploy.
"""

# %% [markdown]
# # Deploy
# The same calls drive a virtual board in this process and a real one on a CAN bus: only the link
# differs.

# %% --8<-- [start:program]
from pathlib import Path

import numpy as np

import muxjax
from muxjax.hardware.faults import FaultConfig
from muxjax.pipeline import run_to_target
from muxjax.program_file import load_program, save_program

folder = Path("out/deploy")
folder.mkdir(parents=True, exist_ok=True)
robot = muxjax.load_robot("muxarm")
target = muxjax.tendon_displacements(robot, np.radians([60, 0, 75, 180, 40, 0]))
plan = muxjax.plan(robot, muxjax.Problem(np.zeros(robot.n_tendons), target, preset="fastest"))
save_program(muxjax.schedule(robot, plan), folder / "program.json")
# --8<-- [end:program]

# %% --8<-- [start:rehearse]
program = load_program(folder / "program.json")
for physics in ["ideal", "realistic"]:
    link = muxjax.LockstepLink(robot, physics)
    run = muxjax.execute(program, link)
    wheels = 1e3 * np.abs(run.measured - target).max()
    truth = 1e3 * np.abs(link.board.mechanics.displacements - target).max()
    print(
        f"{physics}: {run.reason}, {run.duration_s:.0f} s, "
        f"wheels within {wheels:.2f} mm, tendons within {truth:.1f} mm"
    )
# --8<-- [end:rehearse]


# %% --8<-- [start:interrupt]
def stop_in_the_second(progress: muxjax.hardware.Progress) -> None:
    """What Ctrl-C does, in the second instruction."""
    if progress.instruction == 2 and progress.phase.startswith("leg"):
        raise KeyboardInterrupt


(folder / "run.journal").unlink(missing_ok=True)
link = muxjax.LockstepLink(robot)
with muxjax.Journal.open(folder / "run.journal") as journal:
    run = muxjax.execute(program, link, journal=journal, on_progress=stop_in_the_second)
print(f"{run.reason}; done: {len(run.records)} of {len(program.instructions)}")
print(f"tendons off by up to {1e3 * np.abs(run.measured - target).max():.0f} mm")
print("can be resumed:", run.resumable)
# --8<-- [end:interrupt]

# %% --8<-- [start:resume]
link.board.power_cycle()  # an ESTOP holds until the board's power-up
with muxjax.Journal.open(folder / "run.journal") as journal:
    run = muxjax.resume(journal, link)
print(f"{run.reason}; wheels within {1e3 * np.abs(run.measured - target).max():.2f} mm")
# --8<-- [end:resume]

# %% --8<-- [start:servo]
stall = FaultConfig(kind="servo_stall", index=3, at_s=15.0)
link = muxjax.LockstepLink(robot, faults=[stall])
run = run_to_target(link, muxjax.hardware.MemoryJournal(), program)
print(f"{run.reason}; without servo {run.failed_servos}, {run.duration_s:.0f} s")
# --8<-- [end:servo]
