"""Your own robot: from its YAML file to a plan and the bill. Shown by docs/tutorials/own_robot.md.

Run it from the repository's root, or change the path below.
"""

# %% [markdown]
# # Your own robot
# A robot is one YAML file. Everything else takes the robot as its first argument.

# %% --8<-- [start:load]
import numpy as np

import muxjax
from muxjax.bom import cost_sheet
from muxjax.schemas import check_file

path = "docs/tutorials/my_arm.yaml"
print("a file of kind", check_file(path))  # every fault by name, if there is one
robot = muxjax.load_robot(path)
print(f"{robot.n_segments} segments, {robot.n_tendons} tendons, {len(robot.axial_map)} positions")
# --8<-- [end:load]

# %% --8<-- [start:look]
bent = np.radians([90, 0, 60, 180])  # theta_1, phi_1, theta_2, phi_2
tool = muxjax.forward_kinematics(robot, bent)
lengths = muxjax.tendon_displacements(robot, bent)
print("tool at [mm]:", np.round(1e3 * tool[:3, 3], 1).tolist())
print("tendons [mm]:", np.round(1e3 * lengths, 1).tolist())
# --8<-- [end:look]

# %% --8<-- [start:reach]
found = muxjax.sweep(robot, samples=2_000_000)
print(f"reach {1e3 * found.reach_radius:.0f} mm, in {1e3 * found.reach_volume:.1f} dm3")
# --8<-- [end:reach]

# %% --8<-- [start:ik]
pose = np.eye(4)
pose[:3, 3] = [0.12, 0.08, 0.24]
only_position = [1, 1, 1, 0, 0, 0]  # two segments: four freedoms, too few for a whole pose
q = muxjax.solve_ik(robot, pose, weights=only_position).check().q
print("configuration [deg]:", np.round(np.degrees(q), 1).tolist())
# --8<-- [end:ik]

# %% --8<-- [start:plan]
problem = muxjax.Problem(np.zeros(robot.n_tendons), muxjax.tendon_displacements(robot, q))
plan = muxjax.plan(robot, problem)
program = muxjax.schedule(robot, plan)
metrics = muxjax.evaluate(robot, program)
run = muxjax.execute(program, muxjax.LockstepLink(robot))
print(f"{plan.status}: {metrics.stages} stages, {metrics.time_s:.1f} s; on the board: {run.reason}")
# --8<-- [end:plan]

# %% --8<-- [start:bom]
sheet = cost_sheet(robot)
print(f"{sheet.motors} motors for {sheet.single_count} tendons, {sheet.total:.2f} USD;")
print(f"{sheet.single_count} single actuators: {sheet.single_total:.2f} USD")
# --8<-- [end:bom]
