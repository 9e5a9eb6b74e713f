"""First plan: from a pose to an arm that is there. Shown by docs/tutorials/first_plan.md."""

# %% [markdown]
# # First plan
# A pose becomes a configuration, tendon lengths, a plan, a program, and motion on a virtual board.

# %% --8<-- [start:pose]
import numpy as np

import muxjax

robot = muxjax.load_robot("muxarm")
pose = np.eye(4)
pose[:3, 3] = [0.15225, 0.0, 0.413777]  # where the tool shall be [m], in the base frame
turn = np.radians(25)  # and how it shall stand: 25 degrees about y
pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
# --8<-- [end:pose]

# %% --8<-- [start:ik]
every = muxjax.all_ik(robot, pose)
for q in every.q[every.mask]:
    print("a configuration [deg]:", np.round(np.degrees(q), 1).tolist())
q = muxjax.solve_ik(robot, pose).check().q  # the nearest to the straight arm; raises if none
# --8<-- [end:ik]

# %% --8<-- [start:lengths]
target = muxjax.tendon_displacements(robot, q)  # [m], negative = wound in
print("tendons [mm]:", np.round(1e3 * target, 1).tolist())
# --8<-- [end:lengths]

# %% --8<-- [start:plan]
start = np.zeros(9)  # the straight arm
for servos in [(1, 2, 3), (1, 2)]:  # all servos, and without the third
    problem = muxjax.Problem(start, target, servos=servos)
    for method in ["sequential", "greedy", "exact"]:
        plan = muxjax.plan(robot, problem, method=method)
        metrics = muxjax.evaluate(robot, muxjax.schedule(robot, plan))
        print(
            f"servos {servos}, {method}: cost {plan.cost:.3f}, {plan.status}, "
            f"{metrics.time_s:.1f} s, {metrics.stages} stages"
        )
# --8<-- [end:plan]

# %% --8<-- [start:program]
program = muxjax.schedule(robot, plan)
for number, step in enumerate(program.instructions, start=1):
    moves = ", ".join(f"servo {s} {1e3 * m:+.1f} mm" for s, m in step.length_moves.items())
    print(f"{number}. drum to {step.axial}, clutches {step.clutches}: {moves}")
# --8<-- [end:program]

# %% --8<-- [start:run]
run = muxjax.execute(program, muxjax.LockstepLink(robot))
print(run.reason)
arrived = muxjax.forward_kinematics(robot, muxjax.configuration_from_tendons(robot, run.measured))
print(f"tool off by {1e3 * np.linalg.norm(arrived[:3, 3] - pose[:3, 3]):.2f} mm")
# --8<-- [end:run]
