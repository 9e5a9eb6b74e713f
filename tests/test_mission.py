"""Ways around obstacles, and whole missions on the virtual board.

The oracle here shares nothing with the rooms it judges: poses by rotation matrices multiplied out,
obstacles by plain NumPy, true displacements from the board's own record, sampled densely.
"""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

import muxjax
from muxjax.cli import main
from muxjax.collision import WorldConfig, world_from_config
from muxjax.hardware import LockstepLink
from muxjax.kinematics import backbone
from muxjax.pipeline.missions.files import MissionConfig, load_mission
from muxjax.pipeline.missions.follow import TubeLine, posture_at
from muxjax.pipeline.missions.plan import Planner
from muxjax.pipeline.missions.run import corners, run_mission
from muxjax.pipeline.missions.scene import frame_pose
from muxjax.pipeline.swept import at_base, base_path, swept_base, swept_tendons
from muxjax.planning import PlanningError, Problem
from muxjax.tendons import tendon_displacements

CLEAR_OF_BOX = 5e-4  # [m]; the oracle samples the arm's axis, which may come this much nearer


def axis_points(robot, q: np.ndarray, n: int = 40) -> np.ndarray:
    """Points along the arm in the world, by M Eq. 1 multiplied out; after the mount."""
    frame, points = np.array(robot.base), []
    for theta, phi, length in zip(q[0::2], q[1::2], robot.length, strict=True):
        for s in np.arange(1, n + 1) / n:
            a, arc = s * theta, s * length
            r, h = (arc / a * (1 - np.cos(a)), arc / a * np.sin(a)) if a > 1e-9 else (0.0, arc)
            points.append(frame[:3, :3] @ [r * np.cos(phi), r * np.sin(phi), h] + frame[:3, 3])
        cz, sz, cy, sy = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta)
        z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        turned = frame[:3, :3] @ z @ y @ z.T
        frame = frame.copy()
        frame[:3, 3], frame[:3, :3] = points[-1], turned
    return np.array(points)[n // 8 :]


def oracle(mission: MissionConfig, points: np.ndarray, radius: float) -> float:
    """Least distance of balls about points to the mission's obstacles [m]."""
    best = np.inf
    for item in mission.obstacles:
        match item.kind:
            case "box":
                over = np.abs(points - item.centre_m) - np.array(item.size_m) / 2
                gap = np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)
            case "half_space":
                gap = (points - item.point_m) @ np.array(item.normal)
            case "tube":
                line = np.array(item.through_m)
                axis = TubeLine(line)
                along = np.linspace(0.0, axis.length, 4000)
                away = np.linalg.norm(points[:, None] - axis.at(along)[None], axis=2)
                # Inside the tube only: what is before the mouth has the rim beside it.
                inside = (points - line[0]) @ axis.before > 0
                gap = np.where(inside, item.bore_radius_m - away.min(axis=1), np.inf)
        best = min(best, float(gap.min()) - radius)
    return best


def judge(robot, mission: MissionConfig, done) -> float:
    """Least clearance of an executed stage, sampled on the board's true timeline."""
    q_of = muxjax.configuration_from_tendons
    share = np.linspace(0, 1, 12, endpoint=False)[:, None, None]
    lengths = done.points
    if len(lengths) > 1:
        between = lengths[:-1] + share * np.diff(lengths, axis=0)
        lengths = np.concatenate([between.reshape(-1, lengths.shape[1]), lengths[-1:]])
    bases = [done.scene.base]
    if done.stage.kind == "base":
        bases = base_path(done.stage.bases, 0.6, 0.01)[0]
    worst = np.inf
    for base in bases:
        arm = at_base(robot, base)
        for q in q_of(robot, lengths):
            worst = min(worst, oracle(mission, axis_points(arm, q), float(robot.body_radius)))
            if done.scene.held is not None:
                tool = np.asarray(backbone(arm, q, 1))[-1]
                ball = tool[:3, :3] @ done.scene.offset + tool[:3, 3]
                size = mission.objects[done.scene.held].radius_m
                worst = min(worst, oracle(mission, ball[None], size))
    return worst


def wall_problem(muxarm, low: float, servos=(1, 2, 3), **fields) -> Problem:
    """From one side of a plate that stands above the arm to the other."""
    box = {"kind": "box", "centre_m": [0, 0, low + 0.15], "size_m": [0.04, 0.8, 0.3]}
    config = WorldConfig(schema="muxjax/world/1", name="plate", obstacles=[box])
    ends = np.radians([[70, 0, 40, 0, 10, 0], [70, 180, 40, 180, 10, 180]])
    start, target = tendon_displacements(muxarm, ends)
    world = world_from_config(config)
    return Problem(start, target, servos=servos, world=world, preset="fastest", **fields)


def test_a_moving_base_keeps_within_its_bound_between_samples():
    begin, end = np.eye(4), np.eye(4)
    end[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    end[:3, 3] = [0.1, 0.0, 0.3]
    poses, gaps = base_path(np.stack([begin, end]), reach=0.5, resolution=0.01)
    assert np.allclose(poses[-1], end)
    far = np.array([0.3, 0.4, 0.0, 1.0])
    moved = np.linalg.norm(np.diff(poses @ far, axis=0)[:, :3], axis=1)
    assert (moved <= gaps + 1e-12).all()
    assert gaps.max() <= 0.01
    assert gaps.sum() == pytest.approx(np.hypot(0.1, 0.3) + 0.5 * np.pi / 2)


def test_swept_clearance_is_a_lower_bound(muxarm):
    config = WorldConfig(
        schema="muxjax/world/1",
        name="post",
        obstacles=[{"kind": "sphere", "centre_m": [0.25, 0.1, 0.3], "radius_m": 0.03}],
    )
    world = world_from_config(config)
    straight = np.zeros(9)
    bent = tendon_displacements(muxarm, np.radians([60, 0, 30, 20, 0, 0]))
    found = swept_tendons(muxarm, world, np.stack([straight, bent]))
    post = np.array([0.25, 0.1, 0.3])
    truth = np.inf
    for share in np.linspace(0, 1, 200):
        q = muxjax.configuration_from_tendons(muxarm, straight + share * (bent - straight))
        away = np.linalg.norm(axis_points(muxarm, q) - post, axis=1).min()
        truth = min(truth, away - 0.03 - float(muxarm.body_radius))
    assert truth - 3e-3 < found.clearance <= truth + 1e-4
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, :2, 3] = 0.25, 0.02
    moving = swept_base(muxarm, world, straight, poses)
    # The straight arm comes nearest to the post at the end of the way.
    expected = 0.08 - 0.03 - float(muxarm.body_radius)
    assert expected - 2e-3 < moving.clearance <= expected + 1e-6
    assert moving.share == pytest.approx(1.0)


def test_the_arm_follows_a_tube_as_deep_as_it_is_long(muxarm):
    line = TubeLine(np.array(load_mission("pipe").tubes[0].through_m))
    posture = None
    for depth in np.linspace(0.02, 0.36, 18):
        posture = posture_at(muxarm, line, float(depth), posture)
        assert posture.off_line < 0.009
        points = axis_points(at_base(muxarm, posture.base), posture.q)
        assert np.linalg.norm(points[-1] - line.at(np.array([depth]))[0]) < 0.009
        root = posture.base[:3, 3] - line.points[0]
        assert root @ line.before < 0  # the root stays outside
    with pytest.raises(ValueError, match="470 mm long, its tip cannot be 500 mm deep"):
        posture_at(muxarm, line, 0.5, posture)


def test_corners_keep_the_polyline():
    from muxjax.hardware import Trajectory

    points = np.zeros((6, 9))
    points[:, 0] = [0, 0, 1, 2, 2, 2]
    points[:, 1] = [0, 0, 0, 0, 0, 3]
    kept = corners(Trajectory(np.arange(6.0), points))
    assert kept[:, :2].tolist() == [[0, 0], [2, 0], [2, 3]]


def run(robot, mission: MissionConfig, servos) -> list:
    planner = Planner(robot, mission, servos=servos)
    return list(run_mission(planner, LockstepLink(robot, stream_divider=10)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cabinet", "pipe"])
@pytest.mark.parametrize("servos", [(1, 2, 3), (1, 2), (1,)])
def test_missions_run_clear_of_everything_to_their_end(muxarm, name, servos):
    mission = load_mission(name)
    done = run(muxarm, mission, servos)
    assert [d.failure for d in done if d.failure] == []
    assert {d.stage.step for d in done} == {step.name for step in mission.steps}
    for item in done:
        assert item.tool_error < 2e-4
        assert item.clearance > mission.margin_m - 5e-4
        judged = judge(muxarm, mission, item)
        assert judged > 0
        assert item.clearance < judged + CLEAR_OF_BOX
        if item.stage.kind == "base":
            assert len(item.points) == 1
        else:
            assert len(item.stage.bases) == 1
    start = np.array(mission.objects[0].centre_m)
    assert np.linalg.norm(done[-1].scene.centres[0] - start) > 0.2
    assert done[-1].scene.held is None


def changed(mission: MissionConfig, **fields) -> MissionConfig:
    return MissionConfig.model_validate(mission.model_dump(by_alias=True) | fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"steps": [{"do": "grasp", "what": "cube"}]}, "no object 'cube'"),
        ({"steps": [{"do": "release"}]}, "the gripper holds nothing"),
        ({"steps": [{"do": "extract", "name": "out"}]}, "nothing was inserted"),
        (
            {"steps": [{"do": "insert", "name": "in", "depth_m": 0.1, "step_m": 0.02}]},
            "the scene has 0 tubes, found 1",
        ),
        ({"steps": [{"do": "move", "name": "m"}]}, "give either to or q_deg"),
        ({"margin_m": 0.0}, "margin_m"),
    ],
)
def test_a_wrong_mission_is_refused_by_field(fields, message):
    with pytest.raises(ValidationError, match=message):
        changed(load_mission("cabinet"), **fields)


def test_a_start_in_collision_and_a_missed_grasp_say_so(muxarm):
    mission = load_mission("cabinet")
    buried = changed(mission, base={"xyz_m": [0.21, 0, 0.4], "rpy_deg": [180, 0, 0]})
    with pytest.raises(ValueError, match=r"base: the straight arm starts -\d+.* the margin is 2.0"):
        Planner(muxarm, buried, servos=(1, 2, 3))
    early = changed(mission, steps=[{"do": "grasp", "what": "ball"}])
    with pytest.raises(PlanningError, match=r"steps\[1\], grasp: ball is .* mm from the grasp"):
        list(Planner(muxarm, early, servos=(1, 2, 3)).stages())
    poke = {"name": "in", "position_m": [0.2, 0, 0.20], "rpy_deg": [180, 0, 0]}
    inside = changed(mission, steps=[{"do": "move", "name": "poke", "to": poke}])
    with pytest.raises(PlanningError, match=r"steps\[1\], poke: of \d+ configurations that reach"):
        list(Planner(muxarm, inside, servos=(1, 2, 3)).stages())
    crash = [{"do": "base", "name": "crash", "through": [{"xyz_m": [0.21, 0, 0.6]}]}]
    with pytest.raises(PlanningError, match=r"crash: on the base's way, \d+ % along"):
        list(Planner(muxarm, changed(mission, steps=crash), servos=(1,)).stages())


def test_frames_are_as_in_robot_files():
    mission = load_mission("cabinet")
    pose = frame_pose(mission.base)
    assert np.allclose(pose[:3, 2], [0, 0, -1])
    assert np.allclose(pose[:3, 3], [0, 0, 0.6])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["task", "attic"], "no 'attic' among the shipped files (cabinet, pipe)"),
        (["task", "cabinet", "--preset", "worst"], "no 'worst' among"),
        (["task", "cabinet", "--robot", "nobody"], "no 'nobody' among"),
    ],
)
def test_the_command_refuses_bad_input(capsys, arguments, message):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert message in capsys.readouterr().err
