"""Clearances against dense sampling written out independently; gradients, files, refusals."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import equinox as eqx
import independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_configurations
from scipy.spatial.transform import Rotation

from muxjax.collision import (
    CapsuleConfig,
    SphereConfig,
    WorldConfig,
    attach,
    bending_clearance,
    clearance,
    load_world,
    part_clearances,
    point_distance,
    tightest,
    world_from_config,
)
from muxjax.config import ConfigError, FrameConfig
from muxjax.robot import Robot, robot_from_config

DENSE = 96  # points a segment; a multiple of the 16 that the code looks at


def world_of(*obstacles: dict, folder: Path | None = None, **more: object):
    raw = {"schema": "muxjax/world/1", "name": "test", "obstacles": list(obstacles), **more}
    return world_from_config(WorldConfig.model_validate(raw), folder)


COMPILED = {fn: jax.jit(fn) for fn in (clearance, bending_clearance, part_clearances, tightest)}


def measured(fn, robot: Robot, q: np.ndarray, world):
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, COMPILED[fn](robot, jnp.asarray(q), world))


# -- an independent oracle -----------------------------------------------------------------------


def to_segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    along = b - a
    t = np.clip((p - a) @ along / max(along @ along, 1e-300), 0, 1)
    return np.linalg.norm(p - a - t[:, None] * along, axis=-1)


def to_obstacle(item: dict, p: np.ndarray) -> np.ndarray:
    """Signed distance of points (n, 3) to one obstacle as its dictionary states it."""
    get = {k: np.array(v, float) for k, v in item.items() if k != "kind" and v is not None}
    match item["kind"]:
        case "sphere":
            return np.linalg.norm(p - get["centre_m"], axis=-1) - get["radius_m"]
        case "capsule":
            return to_segment(p, get["from_m"], get["to_m"]) - get["radius_m"]
        case "half_space":
            normal = get["normal"] / np.linalg.norm(get["normal"])
            return (p - get["point_m"]) @ normal
        case "box":
            turn = Rotation.from_euler("xyz", get.get("rpy_deg", np.zeros(3)), degrees=True)
            over = np.abs(turn.inv().apply(p - get["centre_m"])) - 0.5 * get["size_m"]
            return np.linalg.norm(np.maximum(over, 0), axis=-1) + np.minimum(over.max(axis=-1), 0)
        case "tube":
            line = get["through_m"]
            away = np.min([to_segment(p, a, b) for a, b in pairwise(line)], 0)
            return get["bore_radius_m"] - away
    raise AssertionError(item)


def truth(robot: Robot, q: np.ndarray, obstacles: list[dict]) -> tuple[float, float]:
    """Clearance from obstacles and from itself, by dense points on the arcs after the mount."""
    frames = independent.backbone(robot, q, DENSE)
    points = np.array(frames)[DENSE // 8 :, :3, 3]
    arc = np.concatenate([[0], np.cumsum(np.repeat(robot.length / DENSE, DENSE))])[DENSE // 8 :]
    tool = np.array(frames)[-1] @ robot.tool
    offset = np.linalg.norm(robot.tool[:3, 3])
    if offset:
        t = np.linspace(0, 1, 40)[1:, None]
        points = np.concatenate([points, points[-1] + t * (tool[:3, 3] - points[-1])])
        arc = np.concatenate([arc, arc[-1] + offset * t[:, 0]])
    radius = float(robot.body_radius)
    outside = min((to_obstacle(o, points).min() for o in obstacles), default=np.inf)
    pairs = np.linalg.norm(points[:, None] - points, axis=-1)
    counted = arc[:, None] - arc >= np.pi * radius
    own = pairs[counted].min() - 2 * radius
    return outside - radius, own


def random_obstacles(rng: np.random.Generator) -> list[dict]:
    """One of each kind, around the arm."""

    def spot() -> list[float]:
        return rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.5]).tolist()

    return [
        {"kind": "sphere", "centre_m": spot(), "radius_m": rng.uniform(0.002, 0.1)},
        {"kind": "capsule", "from_m": spot(), "to_m": spot(), "radius_m": rng.uniform(0.002, 0.05)},
        {
            "kind": "box",
            "centre_m": spot(),
            "size_m": rng.uniform(0.01, 0.3, 3).tolist(),
            "rpy_deg": rng.uniform(-180, 180, 3).tolist(),
        },
        {"kind": "half_space", "point_m": [0, 0, -0.3], "normal": rng.normal(size=3).tolist()},
    ]


def test_clearance_is_never_above_the_truth_and_hardly_below(robot, rng):
    """One obstacle of each kind at random; near contact less than two millimetres off."""
    near = 0
    for _ in range(20):
        q = random_configurations(robot, rng, 6) * 0.5
        items = random_obstacles(rng)
        for value, row in zip(measured(clearance, robot, q, world_of(*items)), q, strict=True):
            outside, own = truth(robot, row, items)
            exact = min(outside, own)
            # Deeper than its own radius the axis is inside; own distances that are large may be
            # those of places just near enough along the arm to be neighbours.
            over = 6e-3 if outside < -float(robot.body_radius) else 2e-3 if own > 0.01 else 1e-6
            assert value <= exact + over
            if abs(exact) < 0.03:
                near += 1
                assert value >= exact - 2e-3
    assert near > 10


def test_clearance_from_obstacles_alone_is_conservative(muxarm, rng):
    """Without the arm's own distances: a ball so near that it decides."""
    for _ in range(25):
        q = random_configurations(muxarm, rng) * 0.6
        frames = np.array(independent.backbone(muxarm, q, 5))[1:, :3, 3]
        centre = frames[rng.integers(2, len(frames))] + 0.045 * rng.normal(size=3) / np.sqrt(3)
        item = {"kind": "sphere", "centre_m": centre.tolist(), "radius_m": 0.001}
        outside, own = truth(muxarm, q, [item])
        value = float(measured(clearance, muxarm, q, world_of(item)))
        if -0.03 < outside < own - 0.005:
            assert outside - 4e-3 <= value <= outside + 1e-6
            if outside > -0.005:
                assert value >= outside - 1.2e-3


def test_self_distance_is_conservative(robot, rng):
    touching = 0
    q = random_configurations(robot, rng, 40)
    q[:, 0::2] = np.maximum(q[:, 0::2], 0.7 * robot.theta_max)
    q[:, 1::2] = q[:, 1:2] + 0.3 * rng.normal(size=(40, robot.n_segments))  # rolled up
    assert measured(clearance, robot, 0 * q, world_of()).min() > 0  # the straight arm
    found = measured(clearance, robot, q, world_of())
    for value, row in zip(found, q, strict=True):
        _, own = truth(robot, row, [])
        assert value <= own + (1e-6 if own < 0.01 else 2e-3)
        if abs(own) < 0.02:
            assert value >= own - 3e-3
        touching += own < 0
    assert touching > 3


def test_tube_walls_and_mouths(muxarm, rng):
    """A wall of 5 mm between open ends, against points of the wall itself."""
    tube = {
        "kind": "tube",
        "through_m": [[0, 0, 0.1], [0, 0, 0.3]],
        "bore_radius_m": 0.05,
        "wall_m": 0.005,
    }
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 181), np.linspace(0.1, 0.3, 101))
    wall = [
        np.stack([r * np.cos(angle), r * np.sin(angle), height], -1).reshape(-1, 3)
        for r in (0.05, 0.0525, 0.055)
    ]
    p = rng.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.4], (400, 3))
    brute = np.linalg.norm(p[:, None] - np.concatenate(wall), axis=-1).min(axis=1)
    with jax.enable_x64(True):
        found = np.asarray(point_distance(world_of(tube), p))
    free = found > 0
    np.testing.assert_allclose(found[free], brute[free], atol=1.5e-3)
    assert (brute[~free] < 3e-3).all()
    assert free.sum() > 300


def test_many_obstacles_equal_one_at_a_time(muxarm, rng):
    """More than are written out go through a loop."""
    balls = [
        {"kind": "sphere", "centre_m": rng.uniform(-0.4, 0.5, 3).tolist(), "radius_m": 0.01}
        for _ in range(30)
    ]
    q = random_configurations(muxarm, rng, 5)
    alone = np.min([measured(clearance, muxarm, q, world_of(b)) for b in balls], axis=0)
    np.testing.assert_allclose(measured(clearance, muxarm, q, world_of(*balls)), alone, atol=1e-12)


@pytest.mark.slow
def test_large_batches_are_cut_into_equal_answers(muxarm, rng):
    q = random_configurations(muxarm, rng, 2051)
    world = load_world("cabinet")
    whole = measured(clearance, muxarm, q.reshape(7, 293, 6), world)
    assert whole.shape == (7, 293)
    rows = [0, 1023, 2047, 2048, 2050]
    parts = measured(clearance, muxarm, q[rows], world)
    np.testing.assert_allclose(whole.reshape(-1)[rows], parts, atol=1e-12)


# -- derivatives ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_gradients_equal_finite_differences(muxarm, rng, tmp_path):
    items = random_obstacles(rng)
    cloud = {"kind": "points", "points_m": rng.uniform(0.1, 0.3, (20, 3)).tolist()}
    world = world_of(*items, {**cloud, "radius_m": 0.01, "spacing_m": 0.02})
    with jax.enable_x64(True):
        value = jax.jit(lambda q: clearance(muxarm, q, world))
        gradient = jax.jit(jax.grad(value))
        for q in random_configurations(muxarm, rng, 8) * 0.7:
            numeric = [(value(q + h) - value(q - h)) / 2e-6 for h in 1e-6 * np.eye(6)]
            np.testing.assert_allclose(gradient(jnp.asarray(q)), numeric, atol=2e-5)
        straight = jax.grad(lambda b: bending_clearance(muxarm, b, world))
        assert np.isfinite(straight(jnp.zeros((3, 2)))).all()


def test_bending_and_configuration_agree(muxarm, rng):
    robot = muxarm
    q = random_configurations(robot, rng, 4)
    b = np.stack([q[:, 0::2] * np.cos(q[:, 1::2]), q[:, 0::2] * np.sin(q[:, 1::2])], axis=-1)
    world = load_world("cabinet")
    np.testing.assert_allclose(
        measured(bending_clearance, robot, b, world),
        measured(clearance, robot, q, world),
        atol=1e-12,
    )


def test_obstacles_can_be_differentiated(muxarm):
    world = world_of({"kind": "sphere", "centre_m": [0.06, 0, 0.3], "radius_m": 0.01})
    with jax.enable_x64(True):
        slope = jax.grad(lambda w: clearance(muxarm, jnp.zeros(6), w))(
            jax.tree.map(jnp.asarray, world)
        )
    assert float(slope.round_radius[0]) == pytest.approx(-1, abs=0.05)


# -- where, and what the tool carries ------------------------------------------------------------


def test_parts_say_where(muxarm):
    """A ball at the tip is hit by the last segment alone."""
    world = world_of({"kind": "sphere", "centre_m": [0, 0, 0.47], "radius_m": 0.01})
    parts = measured(part_clearances, muxarm, np.zeros(6), world)
    assert parts.shape == (3,)
    assert parts[2] < 0
    assert (parts[:2] > 0).all()
    where = measured(tightest, muxarm, np.zeros((2, 6)), world)
    assert where.part.tolist() == [3, 3]
    np.testing.assert_allclose(where.point, [[0, 0, 0.47]] * 2, atol=1e-12)
    np.testing.assert_allclose(where.clearance, parts[2])


def test_a_grasped_shape_moves_with_the_tool(muxarm, rng):
    world = world_of({"kind": "sphere", "centre_m": [0.3, 0.1, 0.3], "radius_m": 0.02})
    grasp = attach(
        attach(world, [SphereConfig(centre_m=(0.0, 0.02, 0.1), radius_m=0.03)]),
        [CapsuleConfig(from_m=(-0.1, 0, 0.12), to_m=(0.1, 0, 0.12), radius_m=0.01)],
    )
    q = random_configurations(muxarm, rng, 30) * 0.5
    found = measured(part_clearances, muxarm, q, grasp)
    assert found.shape == (30, 4)
    for row, value in zip(q, found[:, 3], strict=True):
        tool = independent.pose(muxarm, row)
        centre = np.array([0.3, 0.1, 0.3])
        ball = tool[:3, :3] @ [0, 0.02, 0.1] + tool[:3, 3]
        ends = [tool[:3, :3] @ [s * 0.1, 0, 0.12] + tool[:3, 3] for s in (-1, 1)]
        exact = min(
            np.linalg.norm(ball - centre) - 0.05,
            float(to_segment(centre[None], *ends)[0]) - 0.03,
        )
        own = float(np.linalg.norm(tool[:3, 3]))  # nothing of the arm itself is that near
        assert value <= exact + 1e-6
        if exact < 0.1 and own > 0.3:
            assert value >= exact - 2e-3


def test_the_tools_shape_replaces_the_default(robot):
    long = robot_from_config(
        robot.config.model_copy(update={"tool_frame": FrameConfig(xyz_m=(0.0, 0.0, 0.1))})
    )
    q = np.zeros(2 * robot.n_segments)
    beside = independent.pose(long, q) @ [0.03, 0.0, -0.01, 1.0]
    beside = {"kind": "sphere", "centre_m": beside[:3].tolist(), "radius_m": 0.005}
    assert measured(clearance, long, q, world_of(beside)) < 0
    thin = [{"kind": "capsule", "from_m": [0, 0, -0.1], "to_m": [0, 0, 0], "radius_m": 0.01}]
    value = float(measured(part_clearances, long, q, world_of(beside, tool=thin))[-1])
    assert 0.013 < value <= 0.015


# -- sampled obstacles ---------------------------------------------------------------------------


def ball_grid(folder: Path, spacing: float = 0.01) -> dict:
    axis = np.arange(-0.15, 0.1501, spacing)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = np.linalg.norm(nodes, axis=-1) - 0.05
    origin = np.array([0.25, 0.0, 0.3]) - 0.15
    np.savez(folder / "ball.npz", values=values, origin=origin, spacing=spacing)
    return {"kind": "grid", "file": "ball.npz", "beyond": "free"}


def test_a_grid_of_a_sphere_is_the_sphere(muxarm, rng, tmp_path):
    sphere = {"kind": "sphere", "centre_m": [0.25, 0.0, 0.3], "radius_m": 0.05}
    grid = world_of(ball_grid(tmp_path), folder=tmp_path)
    exact = world_of(sphere)
    p = np.array([0.25, 0.0, 0.3]) + rng.normal(size=(500, 3)) * 0.2
    with jax.enable_x64(True):
        found, true = (np.asarray(point_distance(w, p)) for w in (grid, exact))
    outside = true > 0
    # The most that interpolation adds: sqrt(d^2 + half the diagonal's square).
    assert (found[outside] <= np.sqrt(true[outside] ** 2 + 0.75e-4) + 1e-12).all()
    inside = np.abs(p - [0.25, 0.0, 0.3]).max(axis=1) < 0.15
    np.testing.assert_allclose(found[inside], true[inside], atol=1.5e-3)
    q = random_configurations(muxarm, rng, 120)
    q[:, 0::2] *= 0.4
    q[:, 1::2] *= 0.1  # towards the ball
    found, true = (measured(clearance, muxarm, q, w) for w in (grid, exact))
    for value, row in zip(found, q, strict=True):
        outside, own = truth(muxarm, row, [sphere])
        if -0.03 < outside < own:
            assert value <= outside + 1e-6
    near = (true > -0.01) & (true < 0.05)
    assert near.sum() > 3
    assert (found[near] >= true[near] - 3e-3).all()


def test_outside_a_grid_nothing_is_taken_for_free_unless_said(tmp_path):
    item = ball_grid(tmp_path)
    known = world_of(item, folder=tmp_path)
    unknown = world_of({**item, "beyond": "unknown"}, folder=tmp_path)
    p = np.array([[0.25, 0.0, 0.3 + 0.15 + 0.2]])
    with jax.enable_x64(True):
        # 0.1 m of clearance at the face, left behind after 0.1 m
        assert float(point_distance(unknown, p)[0]) == pytest.approx(0.1 - 0.2, abs=1e-3)
        assert 0.2 < float(point_distance(known, p)[0]) <= 0.3


@pytest.mark.parametrize("suffix", ["npy", "npz", "csv", "xyz", "inline"])
def test_points_from_any_file_are_balls(rng, tmp_path, suffix):
    points = rng.uniform([0.1, -0.2, 0.2], [0.3, 0.2, 0.5], (40, 3)).round(4)
    item: dict = {"kind": "points", "radius_m": 0.004, "spacing_m": 0.012}
    if suffix == "inline":
        item["points_m"] = points.tolist()
    else:
        item["file"] = f"cloud.{suffix}"
    if suffix == "npy":
        np.save(tmp_path / "cloud.npy", points)
    if suffix == "npz":
        np.savez(tmp_path / "cloud.npz", points=points)
    if suffix == "csv":
        np.savetxt(tmp_path / "cloud.csv", points, delimiter=",", header="x,y,z", comments="")
    if suffix == "xyz":
        np.savetxt(tmp_path / "cloud.xyz", points)
    grid = world_of(item, folder=tmp_path).grids[0]
    assert grid.free
    nodes = np.moveaxis(np.indices(grid.values.shape), 0, -1) * grid.spacing + grid.origin
    away = np.linalg.norm(nodes[::5, ::5, ::5, None] - points, axis=-1).min(axis=-1)
    np.testing.assert_allclose(grid.values[::5, ::5, ::5], away - 0.004, atol=1e-12)


def test_a_point_cloud_is_never_farther_than_its_balls(muxarm, rng):
    points = rng.uniform([0.1, -0.2, 0.2], [0.3, 0.2, 0.5], (3000, 3))
    points = points[np.linalg.norm(points - [0.2, 0.0, 0.35], axis=1) > 0.08]
    cloud = {"kind": "points", "points_m": points.tolist(), "radius_m": 0.004}
    p = rng.uniform([0.05, -0.25, 0.15], [0.35, 0.25, 0.55], (300, 3))
    with jax.enable_x64(True):
        found = np.asarray(point_distance(world_of(cloud), p))
    true = np.linalg.norm(p[:, None] - points, axis=-1).min(axis=1)
    # 10 mm cells: sqrt(d^2 + half the diagonal's square), d to the ball's centre
    assert (found + 0.004 <= np.sqrt(true**2 + 0.75e-4) + 1e-12).all()
    assert (found + 0.004 >= true - 0.75e-4**0.5).all()


# -- shipped worlds and refusals -----------------------------------------------------------------


@pytest.mark.parametrize(("name", "height"), [("cabinet", 0.0), ("s_pipe", -0.3)])
def test_shipped_worlds_hold_clear_and_blocked_configurations(muxarm, rng, name, height):
    base = np.eye(4)
    base[2, 3] = height
    arm = eqx.tree_at(lambda r: r.base, muxarm, base)
    q = random_configurations(arm, rng, 400)
    q[:, 0::2] *= 0.5
    q[200:, 0::2] *= 0.1
    found = measured(clearance, arm, q, load_world(name))
    assert (found < 0).any()
    assert (found > 0).any()


def test_a_file_names_its_neighbours(tmp_path):
    ball_grid(tmp_path)
    path = tmp_path / "mine.yaml"
    path.write_text(
        "schema: muxjax/world/1\nname: mine\nobstacles:\n  - {kind: grid, file: ball.npz}\n"
    )
    world = load_world(path)
    assert world.grids[0].values.shape == (31, 31, 31)
    assert world.fingerprint != load_world("cabinet").fingerprint


GRID = {"values": np.zeros((3, 3, 3)), "origin": np.zeros(3), "spacing": 0.1}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": np.zeros((3, 3))}, r"values must have three axes.*\(3, 3\)"),
        ({"values": np.full((3, 3, 3), np.nan)}, r"values entry \(0, 0, 0\) is nan"),
        ({"spacing": 0.0}, "spacing must be above 0"),
        ({"origin": np.zeros(2)}, "origin must be 3 numbers"),
        ({"spacing": None}, "holds no array spacing"),
        ({"values": np.array("text")}, "values must be numbers"),
    ],
)
def test_bad_grids_are_refused(tmp_path, change, message):
    arrays = {k: v for k, v in {**GRID, **change}.items() if v is not None}
    np.savez(tmp_path / "g.npz", **arrays)
    with pytest.raises(ConfigError, match=r"obstacles\[1\].*" + message):
        world_of({"kind": "grid", "file": "g.npz"}, folder=tmp_path)


def test_bad_files_are_refused(tmp_path):
    def refuse(message: str, **item: object) -> None:
        with pytest.raises(ConfigError, match=message):
            world_of(item, folder=tmp_path)

    refuse("none.npz: no such file", kind="grid", file="none.npz")
    refuse("must end in .npz or .npy", kind="grid", file="g.txt")
    refuse("no such file", kind="points", file="cloud.npy", radius_m=0.01)
    (tmp_path / "g.npz").write_bytes(b"not arrays")
    refuse("not readable as arrays", kind="grid", file="g.npz")
    np.save(tmp_path / "g.npy", np.zeros((3, 3, 3)))
    refuse("needs origin_m and spacing_m", kind="grid", file="g.npy")
    (tmp_path / "c.csv").write_text("x,y,z\n1,2,3\n1,2\n")
    refuse(r"line 3: must be three numbers", kind="points", file="c.csv", radius_m=0.01)
    (tmp_path / "e.csv").write_text("x,y,z\n")
    refuse("must be n x 3", kind="points", file="e.csv", radius_m=0.01)
    (tmp_path / "n.csv").write_text("1,2,nan\n")
    refuse("is nan, not finite", kind="points", file="n.csv", radius_m=0.01)
    (tmp_path / "f.xyz").write_text("0 0 0\n100 100 100\n")
    refuse("spacing_m: 0.01 m over", kind="points", file="f.xyz", radius_m=0.01)


def test_bad_worlds_are_refused():
    with pytest.raises(ConfigError, match="no 'attic' among the shipped files"):
        load_world("attic")
    with pytest.raises(ValueError, match=r"obstacles\[1\]\.normal: must not be zero"):
        world_of({"kind": "half_space", "point_m": [0, 0, 0], "normal": [0, 0, 0]})
    with pytest.raises(ValueError, match="radius_m"):
        world_of({"kind": "sphere", "centre_m": [0, 0, 0], "radius_m": -1})
    with pytest.raises(ValueError, match="give either file or points_m"):
        world_of({"kind": "points", "radius_m": 0.1})
