"""The tasks of M VII: their configurations are clear, and solve_ik finds such ones itself."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from muxjax.collision import clearance, load_world
from muxjax.config import TargetConfig, TaskConfig, load_yaml, resolve
from muxjax.ik import IkStatus, solve_ik
from muxjax.kinematics import forward_kinematics
from muxjax.robot import Robot

BLOCKED = {"cabinet": "inside the cabinet", "s_pipe": "through the wall"}
COMPILED = jax.jit(clearance)


def on_its_base(robot: Robot, target: TargetConfig) -> Robot:
    if target.base is None:
        return robot
    turn = Rotation.from_euler("xyz", target.base.rpy_deg, degrees=True)
    frame = RigidTransform.from_components(target.base.xyz_m, turn).as_matrix()
    return eqx.tree_at(lambda r: r.base, robot, frame)


def pose_of(target: TargetConfig) -> np.ndarray:
    turn = Rotation.from_quat(target.quaternion_wxyz, scalar_first=True)
    return RigidTransform.from_components(target.position_m, turn).as_matrix()


@pytest.mark.parametrize("name", BLOCKED)
def test_each_target_is_clear_but_one(muxarm, name):
    task = load_yaml(TaskConfig, resolve(name, "tasks"))
    assert task.world == name
    world = load_world(task.world)
    detours = 0
    for target in task.targets:
        arm, pose = on_its_base(muxarm, target), pose_of(target)
        found, nearest = solve_ik(arm, pose, world=world), solve_ik(arm, pose)
        assert nearest.converged
        if target.name == BLOCKED[name]:
            assert found.status == IkStatus.BLOCKED
            assert found.clearance < 0
            continue
        q = np.radians(target.near_q_deg)
        reached = forward_kinematics(arm, q)
        np.testing.assert_allclose(reached, pose, atol=2e-6)
        with jax.enable_x64(True):
            given, own = (float(COMPILED(arm, jnp.asarray(x), world)) for x in (q, nearest.q))
        assert given > 0.002
        assert found.converged
        assert found.clearance >= 0
        detours += own < 0
    assert detours >= (name == "cabinet")
