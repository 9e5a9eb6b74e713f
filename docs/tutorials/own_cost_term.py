"""Your own cost term, and one with data. Shown by docs/tutorials/own_cost_term.md."""

# %% [markdown]
# # Your own cost term
# Planners minimise a weighted sum of named terms. A term of your own is a function of the robot and
# of a batch of steps; one that needs data is a small class.

# %% --8<-- [start:problem]
import equinox as eqx
import jax.numpy as jnp
import numpy as np

import muxjax
from muxjax.kinematics import pose_from_bending
from muxjax.planning import Transition
from muxjax.robot import Robot
from muxjax.tendons import bending_from_displacements

robot = muxjax.load_robot("muxarm")
target = muxjax.tendon_displacements(robot, np.radians([70, 225, 90, 45, 55, 45]))
start = np.zeros(robot.n_tendons)
# --8<-- [end:problem]


# %% --8<-- [start:term]
def tool(robot: Robot, displacements: jnp.ndarray) -> jnp.ndarray:
    """Tool position [m] for displacements of any leading axes."""
    return pose_from_bending(robot, bending_from_displacements(robot, displacements))[..., :3, 3]


def sway(robot: Robot, t: Transition) -> jnp.ndarray:
    """How far the tool leans out from the axis, integrated over the step's time [m s]."""
    out_before = jnp.linalg.norm(tool(robot, t.before)[..., :2], axis=-1)
    out_halfway = jnp.linalg.norm(tool(robot, (t.before + t.after) / 2)[..., :2], axis=-1)
    return t.wait * out_before + t.duration * out_halfway


# --8<-- [end:term]


# %% --8<-- [start:compare]
def show(name: str, problem: muxjax.Problem) -> None:
    """Plan, and print how far the tool leans out on the way."""
    plan = muxjax.plan(robot, problem)
    if plan.status == "failed":
        print(f"{name}: no plan, {plan.reason}")
        return
    legs = zip(plan.displacements[:-1], plan.displacements[1:], strict=True)
    way = np.concatenate([np.linspace(before, after, 20) for before, after in legs])
    poses = muxjax.forward_kinematics(robot, muxjax.configuration_from_tendons(robot, way))
    lean = np.linalg.norm(poses[:, :2, 3], axis=1).max()
    seconds = muxjax.evaluate(robot, muxjax.schedule(robot, plan)).time_s
    print(f"{name}: {plan.status}, {seconds:.1f} s, leans out by {1e3 * lean:.0f} mm")


for weight in [0.0, 50.0]:  # a second costs 1, a metre for a second costs this much
    weights = {"time": 1.0, "sway": weight}
    problem = muxjax.Problem(start, target, weights=weights, terms={"sway": sway})
    show(f"sway at {weight:g}", problem)
# --8<-- [end:compare]


# %% --8<-- [start:module]
class Within(eqx.Module):
    """Forbids steps on which the tool leans out too far: a term that is not finite forbids."""

    radius: float  # [m]; traced, so that another radius needs no other compilation

    def __call__(self, robot: Robot, t: Transition) -> jnp.ndarray:
        """0 or infinite."""
        share = jnp.linspace(0.0, 1.0, 9)[:, None]
        way = t.before[..., None, :] + share * (t.after - t.before)[..., None, :]
        lean = jnp.max(jnp.linalg.norm(tool(robot, way)[..., :2], axis=-1), axis=-1)
        return jnp.where(lean > self.radius, jnp.inf, 0.0)


for radius in [0.15, 0.10, 0.05]:
    weights = {"time": 1.0, "within": 1.0}
    problem = muxjax.Problem(start, target, weights=weights, terms={"within": Within(radius)})
    show(f"within {1e3 * radius:.0f} mm", problem)
# --8<-- [end:module]
