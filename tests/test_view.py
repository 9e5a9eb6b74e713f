"""The viewer: its shapes and timeline, its controls without a browser, and in a real one."""

from __future__ import annotations

import socket
import threading
import time
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest

import muxjax
from muxjax.cli import main
from muxjax.collision import load_world
from muxjax.hardware import Journal, LockstepLink
from muxjax.hardware.faults import FaultConfig
from muxjax.hardware.journal import (
    DoneEntry,
    Entry,
    LegEntry,
    ProgramEntry,
    RepairEntry,
    ServoEntry,
    SessionEntry,
)
from muxjax.hardware.log import LoggedLink
from muxjax.metrics.program import timeline
from muxjax.pipeline import run_to_target
from muxjax.plan_file import save_plan
from muxjax.planning.world import clearance_of
from muxjax.program_file import save_program
from muxjax.scheduler import waypoints
from muxjax.trajectory_file import load_trajectory, sample, save_trajectory
from muxjax.viz import drum, scene
from muxjax.viz.desk import Desk
from muxjax.viz.obstacles import sampled_cloud, solids, sweep_cloud
from muxjax.viz.panel import BY_HAND, NOTHING, legend_html
from muxjax.viz.playback import track_of_program
from muxjax.viz.recorded import read_track, track_of_journal
from muxjax.viz.screenshot import (
    NoBrowserError,
    find_browser,
    headless_browser,
    open_viewer,
    press,
    settle,
)
from muxjax.viz.surroundings import view_of
from muxjax.viz.viewer import Viewer
from tests.conftest import random_configurations

Q = np.radians([60.0, 0.0, 75.0, 180.0, 40.0, 30.0])


@pytest.fixture(scope="module")
def arm():
    return muxjax.load_robot("muxarm")


@pytest.fixture(scope="module")
def program(arm):
    problem = muxjax.Problem(np.zeros(9), muxjax.tendon_displacements(arm, Q), servos=(1, 3))
    return muxjax.schedule(arm, muxjax.plan(arm, problem))


# Shapes


def test_discs_stand_on_the_backbone_at_equal_distances(robot, rng):
    q = random_configurations(robot, rng)
    frames, of = scene.guide_frames(robot, q), scene.guide_segments(robot)
    assert len(frames) == len(of) == 1 + robot.n_discs.sum()
    fine = int(np.lcm.reduce(robot.n_discs.astype(int)))  # has a frame at every disc
    along = muxjax.backbone(robot, q, fine)
    for segment, count in enumerate(robot.n_discs.astype(int)):
        places = segment * fine + fine // count * np.arange(1, count + 1)
        own = frames[1:][of[1:] == segment]
        np.testing.assert_allclose(own, along[places], atol=1e-12)
    np.testing.assert_allclose(frames[0], robot.base)


def test_tendons_pass_the_guides_at_r_and_their_azimuth(robot, rng):
    # Any routing, not only straight along the arm.
    azimuth = robot.tendon_azimuth + rng.uniform(0.0, 1.0, robot.tendon_azimuth.shape)
    robot = eqx.tree_at(lambda r: r.tendon_azimuth, robot, azimuth)
    frames = scene.guide_frames(robot, random_configurations(robot, rng))
    of = scene.guide_segments(robot)
    for c, path in enumerate(scene.tendon_points(robot, frames)):
        segment, j = divmod(c, robot.tendons_per_segment)
        own = frames[: len(path)]
        local = np.einsum("pji,pj->pi", own[:, :3, :3], path - own[:, :3, 3])
        assert len(path) == np.count_nonzero(of <= segment)
        psi = azimuth[of[of <= segment], segment, j]
        wanted = float(robot.tendon_radius) * np.stack([np.cos(psi), np.sin(psi), 0 * psi], axis=-1)
        np.testing.assert_allclose(local, wanted, atol=1e-12)


def test_straight_tendons_are_as_long_as_eq_6_says(robot, rng):
    q = random_configurations(robot, rng)
    paths = scene.tendon_points(robot, scene.guide_frames(robot, q))
    length = np.array([np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in paths])
    straight = np.repeat(np.cumsum(robot.length), robot.tendons_per_segment)
    wanted = muxjax.tendon_displacements(robot, q)
    np.testing.assert_allclose(length - straight, wanted, atol=1e-12)


def test_states_differ_by_more_than_colour():
    lengths, moving = np.array([0.0, 0.01, -0.01, 0.01]), np.array([0, 0, 0, 1], bool)
    states = scene.tendon_states(lengths, moving)
    assert states == ("held", "paid out", "wound in", "moving")
    looks = scene.looks_by_state(states)
    assert len({(look.thickness, look.dashed) for look in looks}) == 4
    grey = [0.3 * r + 0.59 * g + 0.11 * b for r, g, b in (look.colour for look in looks)]
    assert min(abs(a - b) for a, b in pairwise(sorted(grey))) > 10
    assert all(state in legend_html("state", 50.0) for state in states)


def test_tension_is_thicker_and_darker_when_tighter():
    tension = np.array([0.0, 20.0, 60.0, 300.0])
    looks = scene.looks_by_tension(tension, 100.0, np.array([False, True, False, False]))
    thick = [look.thickness for look in looks]
    bright = [sum(look.colour) for look in looks]
    assert thick == sorted(thick)
    assert bright == sorted(bright, reverse=True)
    assert thick[0] < thick[-1]
    assert bright[0] > bright[-1]
    assert [look.dashed for look in looks] == [False, True, False, False]
    assert "300 N" in legend_html("tension", 300.0)


def test_a_tube_keeps_its_radius_and_faces_out():
    line = np.array([[0, 0, 0], [0, 0, 1], [0.3, 0.2, 1.7], [1.0, 0.4, 1.9]], float)
    vertices, faces = scene.tube_mesh(line, 0.05, 24)
    rings = vertices.reshape(4, 24, 3)
    np.testing.assert_allclose(np.linalg.norm(rings - line[:, None], axis=-1), 0.05)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals, centres = np.cross(b - a, c - a), (a + b + c) / 3
    first = faces.max(axis=1) < 48  # of the first piece, about the z axis
    outward = np.sum(normals[first] * (centres[first] * [1, 1, 0]), axis=1)
    assert np.all(outward > 0)


def test_dashes_leave_gaps_and_plain_lines_none():
    points = np.cumsum(np.ones((5, 3)), axis=0)
    for dashed, share in ((False, 1.0), (True, 0.55)):
        pieces = scene.strokes(points, dashed=dashed)
        np.testing.assert_allclose(pieces[:, 0], points[:-1])
        np.testing.assert_allclose(pieces[:, 1] - pieces[:, 0], share * np.diff(points, axis=0))


# The drum


def test_every_servo_faces_the_plug_that_the_axial_map_names(robot):
    plugs = drum.plugs(robot)
    assert sorted(p.tendon for p in plugs) == list(range(robot.n_tendons))
    for a in range(len(robot.axial_map)):
        for s in range(robot.tendons_per_segment):
            tip = drum.servo_place(robot, s, float(a)).tip
            gaps = [np.linalg.norm(tip - p.face) for p in plugs]
            nearest = plugs[int(np.argmin(gaps))]
            assert nearest.tendon == robot.axial_map[a, s] == drum.facing(robot, a + 1)[s]
            assert min(gaps) == pytest.approx(drum.GAP)


def test_shafts_bridge_engaged_clutches_alone(arm):
    tendons = drum.facing(arm, 4)
    engaged = np.isin(np.arange(9), tendons[:2])
    lines = drum.shafts(arm, 4, engaged)
    assert len(lines) == 2
    faces = {p.tendon: p.face for p in drum.plugs(arm)}
    for line, tendon in zip(lines, tendons[:2], strict=True):
        np.testing.assert_allclose(line[1], faces[tendon], atol=1e-12)
    assert not len(drum.shafts(arm, 0, engaged))


def test_failed_servos_are_crossed_and_hands_turn_with_the_wheels(arm):
    assert len(drum.crosses(arm, np.zeros(3, bool), 0.0)) == 0
    one = drum.crosses(arm, np.array([False, True, False]), 2.5)
    middle = drum.servo_place(arm, 1, 2.5).frame[:3, 3]
    assert np.linalg.norm(one.mean(axis=(0, 1)) - middle) < max(drum.SERVO)
    quarter = np.zeros(9)
    quarter[4] = float(arm.wheel_radius) * np.pi / 2
    before, after = drum.needles(arm, np.zeros(9)), drum.needles(arm, quarter)
    turned = np.sum(np.diff(before, axis=1) * np.diff(after, axis=1), axis=(1, 2))
    assert np.flatnonzero(np.abs(turned) < 1e-12).tolist() == [4]


# Obstacles and workspace


@pytest.mark.parametrize(
    ("name", "kinds"), [("cabinet", ["box"] * 5 + ["plane"]), ("s_pipe", ["tube"] * 2)]
)
def test_surfaces_lie_where_the_collision_model_has_them(arm, name, kinds):
    world = load_world(name)
    found = solids(world, arm.base[:3, 3])
    assert [s.kind for s in found] == kinds
    if name == "cabinet":
        box = found[0].vertices
        np.testing.assert_allclose(box.min(axis=0), [0.22, -0.20, -0.10], atol=1e-12)
        np.testing.assert_allclose(box.max(axis=0), [0.38, 0.20, 0.24], atol=1e-12)
        np.testing.assert_allclose(found[-1].vertices[:, 2], -0.10, atol=1e-12)
        a, b, c = (box[found[0].faces[:, k]] for k in range(3))
        outward = (a + b + c) / 3 - box.mean(axis=0)
        assert np.all(np.sum(np.cross(b - a, c - a) * outward, axis=1) > 0)
    else:
        line, bore = np.asarray(world.tube_line[0]), float(world.tube_bore[0])
        ring = found[0].vertices[:32]
        np.testing.assert_allclose(np.linalg.norm(ring - line[0], axis=1), bore)


@pytest.mark.parametrize("beside", [0.0, 0.6])
@pytest.mark.parametrize("tall", [0.4, 1.0])
def test_the_view_holds_every_point_beside_the_panel(rng, beside, tall):
    points = rng.uniform([-0.4, -0.3, 0.0], [0.2 + beside, 0.2, tall], (200, 3))
    place, onward = view_of(points)
    right = np.cross(onward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = points - place
    half = (away @ onward) * np.tan(np.radians(45) / 2)  # of the page's height, there
    assert (half > 0).all()
    across, up = away @ right / half, away @ np.cross(right, onward) / half
    assert np.abs(up).max() <= 0.96 + 1e-9
    assert across.min() >= -1.55 * 0.96 - 1e-9
    assert across.max() <= 1.55 * 0.38 + 1e-9
    # And it is no further away than it must be.
    tight = np.ptp(np.r_[up.min(), up.max()]) > 1.8, across.max() - across.min() > 1.9
    assert any(tight)


def test_a_sampled_cloud_lies_within_reach(arm):
    points = sampled_cloud(arm, 500)
    assert points.dtype == np.float32
    assert np.linalg.norm(points, axis=1).max() <= np.sum(arm.length) * (1 + 1e-5)
    assert points[:, 1].min() >= 0  # the half behind the arm


@pytest.mark.slow
def test_a_sweeps_cloud_lies_within_reach(arm):
    sweep = muxjax.sweep(arm, samples=1 << 17, cells=(8, 16))
    cells, dexterity = sweep_cloud(arm, sweep)
    assert np.all((dexterity >= 0) & (dexterity <= 1))
    assert np.linalg.norm(cells[:, :2], axis=1).max() <= sweep.reach_radius
    with pytest.raises(ValueError, match="sweep: of robot 'muxarm', whose length_m"):
        sweep_cloud(muxjax.load_robot("penta"), sweep)


# The timeline


def test_a_programs_track_is_its_timeline_and_ends_at_the_target(arm, program):
    track = track_of_program(arm, program, "mine")
    line = timeline(arm, program)
    assert track.duration_s == line.time_s[-1]
    np.testing.assert_allclose(track.at(track.duration_s).displacements, program.target)
    np.testing.assert_allclose(track.at(-1.0).displacements, program.start)
    assert track.at(1e9).marks.phase == "done"
    assert not track.at(1e9).moving.any()
    times = [mark.since_s for mark in track.marks]
    assert times == sorted(times)
    for item in program.instructions:
        mark = next(
            m
            for m in track.marks
            if m.phase.endswith(("move", "moves"))
            and np.flatnonzero(m.engaged).tolist() == [c - 1 for c in item.clutches]
        )
        moment = track.at(mark.since_s + 0.2)
        assert moment.slot == item.axial
        assert set(np.flatnonzero(moment.moving) + 1) <= set(item.clutches)
        assert moment.moving.any()
    assert track.marks[0].lost.tolist() == [False, True, False]
    assert {track.at(time_s).marks.left_out for time_s in line.time_s} == {(2,)}


def test_a_turning_drum_is_between_its_positions(arm, program):
    track = track_of_program(arm, program, "mine")
    turning = [m for m in track.marks if "drum turns" in m.phase]
    assert turning
    moment = track.at(turning[-1].since_s + 1.0)
    assert moment.slot == 0
    assert not moment.marks.engaged.any()


def test_files_of_every_kind_are_read(arm, program, tmp_path):
    save_program(program, tmp_path / "program.json")
    plan = muxjax.plan(
        arm, muxjax.Problem(program.start, program.target, servos=(1, 3)), "sequential"
    )
    save_plan(plan, tmp_path / "plan.json")
    samples = sample(arm, timeline(arm, program))
    save_trajectory(samples, tmp_path / "line.csv")
    save_trajectory(samples, tmp_path / "line.npz")
    for name in ("program.json", "plan.json", "line.csv", "line.npz"):
        track = read_track(arm, tmp_path / name)
        np.testing.assert_allclose(
            track.at(track.duration_s).displacements, program.target, atol=1e-9
        )
    np.testing.assert_array_equal(
        load_trajectory(arm, tmp_path / "line.npz").displacements, samples.displacements
    )


@pytest.fixture(scope="module")
def recorded(arm, program, tmp_path_factory):
    """A run on the virtual board: its folder, with log and journal, and what happened."""
    folder = tmp_path_factory.mktemp("run")
    link = LoggedLink(LockstepLink(arm, stream_divider=10), folder / "run.log")
    with Journal.open(folder / "run.journal") as journal:
        run = muxjax.execute(program, link, journal=journal)
    link.close()
    assert run.completed
    return folder, run


def test_a_log_of_the_bus_plays_the_run(arm, program, recorded):
    folder, run = recorded
    track = read_track(arm, folder / "run.log")
    assert track.duration_s == pytest.approx(run.duration_s, abs=2.0)
    end = track.at(track.duration_s)
    np.testing.assert_allclose(end.displacements, run.measured, atol=5e-5)
    assert end.slot == program.instructions[-1].axial
    engaged = {tuple(np.flatnonzero(m.engaged) + 1) for m in track.marks if m.engaged.any()}
    assert {i.clutches for i in program.instructions} <= engaged
    # Halfway, the wheels are where the board's true ones were.
    half = track.duration_s / 2
    true = run.trajectory.at(run.trajectory.time_s[:1] + half)[0]
    assert np.abs(track.at(half).displacements - true).max() < 5e-3


def test_a_journal_plays_the_run_without_being_touched(arm, program, recorded):
    folder, run = recorded
    path = folder / "run.journal"
    before = path.read_bytes()
    with Journal.open(path):  # as if a run was still writing it
        track = read_track(arm, path)
    assert path.read_bytes() == before
    end = track.at(track.duration_s)
    np.testing.assert_allclose(end.displacements, run.measured, atol=5e-5)
    assert end.marks.phase == "completed"
    np.testing.assert_allclose(track.target, program.target)
    moving = [m for m in track.marks if m.phase.endswith(("move", "moves"))]
    assert len(moving) >= len(program.instructions)


def entries_of(arm, program) -> list[Entry]:
    """What the journal of a run without errors says."""
    entries: list[Entry] = [ProgramEntry(program=program, goals=())]
    for number, (item, points) in enumerate(
        zip(program.instructions, waypoints(arm, program), strict=True), start=1
    ):
        for leg, (before, after) in enumerate(pairwise(points), start=1):
            goals = {c: after[c - 1] for c in item.clutches}
            entries.append(LegEntry(visit=number, leg=leg, goals=goals, lengths=tuple(before)))
        entries.append(DoneEntry(visit=number, lengths=tuple(points[-1])))
    return entries


def test_a_journals_times_are_those_of_eq_14(arm, program):
    first = program.instructions[0]
    for axial, items in (
        (None, program.instructions),
        (first.axial, program.instructions),
        (first.axial, (first, first)),  # the drum never turns
    ):
        chosen = replace(program, axial=axial, instructions=items)
        line = timeline(arm, chosen)
        track = track_of_journal(arm, entries_of(arm, chosen), "mine")
        assert track.duration_s == pytest.approx(line.time_s[-1])
        turning = [m for m in track.marks if "drum turns" in m.phase]
        turns = np.diff([axial or 0, *(item.axial for item in items)]) != 0
        assert len(turning) == np.count_nonzero(turns)
        predicted = track_of_program(arm, chosen, "mine")
        for time_s in line.time_s:
            assert track.at(time_s).axial == pytest.approx(predicted.at(time_s).axial)


def test_the_next_run_of_a_journal_begins_elsewhere_at_once(arm, program):
    once = entries_of(arm, program)
    one = track_of_journal(arm, once, "one")
    ends, starts = np.array(program.target), np.array(program.start)
    measured = SessionEntry(session=2, boot_count=1, lengths=tuple(starts))
    for second in (once, [measured, *once[1:]]):  # a new program; the same one on a new board
        two = track_of_journal(arm, [*once, *second], "two")
        assert two.duration_s == pytest.approx(2 * one.duration_s, abs=0.01)
        before, after = two.at(one.duration_s - 1e-9), two.at(one.duration_s)
        np.testing.assert_allclose(before.displacements, ends, atol=1e-3)
        np.testing.assert_allclose(after.displacements, starts, atol=1e-9)
        assert not after.moving.any()
        assert any("its start is elsewhere" in mark.phase for mark in two.marks)
        np.testing.assert_allclose(two.at(two.duration_s).displacements, ends, atol=1e-3)


def test_a_repaired_encoder_moves_nothing_in_time(arm, program):
    entries = entries_of(arm, program)
    plain = track_of_journal(arm, entries, "mine")
    lengths = (*entries[-1].lengths[:-1], entries[-1].lengths[-1] + 0.003)
    repair = RepairEntry(encoders=(9,), lengths=lengths)
    track = track_of_journal(arm, [*entries, repair], "mine")
    assert track.duration_s == plain.duration_s
    assert track.marks[-1].phase == "repaired encoders: [9]"
    np.testing.assert_allclose(track.at(track.duration_s).displacements, lengths)


def test_servos_that_a_program_left_out_are_back_in_the_next_one(arm, program):
    entries = entries_of(arm, program)  # servos 1 and 3
    later = ProgramEntry(program=replace(program, servos=(1, 2, 3)), goals=())
    lost = [track_of_journal(arm, more, "mine").marks[-1].lost.tolist() for more in (
        entries,
        [*entries, later],
        [*entries, ServoEntry(servo=3, reason="stalled"), later],
    )]  # fmt: skip
    entry = track_of_journal(arm, [*entries, ServoEntry(servo=3, reason="stalled")], "mine")
    assert [m.left_out for m in (entry.marks[0], entry.marks[-1])] == [(2,), (2,)]
    assert entry.marks[-1].lost.tolist() == [False, True, True]
    assert lost == [[False, True, False], [False] * 3, [False] * 3]


def test_a_servo_that_dies_in_a_run_is_out_of_use_from_then_on(arm, program, tmp_path):
    # The journal of a run that went on without servo 3, and the log of both its parts.
    dies = FaultConfig(kind="servo_offline", index=3, at_op="START", nth=2, delay_s=0.4)
    link = LoggedLink(LockstepLink(arm, faults=[dies], stream_divider=5), tmp_path / "run.log")
    with Journal.open(tmp_path / "run.journal") as journal:
        run = run_to_target(link, journal, program)
    link.close()
    assert run.completed
    for name in ("run.journal", "run.log"):
        track = read_track(arm, tmp_path / name)
        lost = [bool(mark.lost[2]) for mark in track.marks]
        assert not lost[0], name
        assert lost[-1], name
        first = lost.index(True)
        assert all(lost[first:]), name
        end = track.at(track.duration_s)
        np.testing.assert_allclose(end.displacements, program.target, atol=5e-5)
        later = track.at((track.marks[first].since_s + track.duration_s) / 2)
        assert later.marks.lost[2], name


def test_files_that_cannot_be_played_say_why(arm, program, recorded, tmp_path):
    save_program(program, tmp_path / "program.json")
    penta = muxjax.load_robot("penta")
    (tmp_path / "empty.journal").write_bytes(b"")
    (tmp_path / "no.log").write_text("(0.0) can0 021#00 R\n")
    (tmp_path / "bad.json").write_text("{")
    (tmp_path / "bad.csv").write_text("time_s,tendon_1_m\n0,1\n")
    (tmp_path / "bad.npz").write_bytes(b"no zip")
    (tmp_path / "damaged.journal").write_bytes(b"00000000 {}\n")
    for robot, name, why in (
        (arm, "none.json", "no such file"),
        (penta, "program.json", "made for robot 'muxarm'"),
        (arm, "empty.journal", "is empty"),
        (arm, "no.log", "at no moment has every wheel"),
        (arm, "bad.json", "Invalid JSON"),
        (arm, "bad.csv", "no column tendon_2_m"),
        (arm, "bad.npz", "not a trajectory"),
        (arm, "damaged.journal", "line 1: checksum"),
        (penta, recorded[0] / "run.journal", "made for robot 'muxarm'"),
        (penta, recorded[0] / "run.log", "a program of another robot; this is 'penta'"),
    ):
        with pytest.raises(ValueError, match=why):
            read_track(robot, tmp_path / name)


# What the desk does


def test_q_and_tendons_stay_consistent(arm):
    desk = Desk(arm)
    desk.set_q_deg(np.degrees(Q))
    np.testing.assert_allclose(desk.displacements, muxjax.tendon_displacements(arm, Q))
    lengths = 1e3 * desk.displacements
    lengths[3] += 2.0
    desk.set_tendons_mm(lengths)
    np.testing.assert_allclose(desk.q, muxjax.configuration_from_tendons(arm, lengths / 1e3))
    assert desk.q[0] == pytest.approx(Q[0])
    assert abs(desk.q[2] - Q[2]) > 1e-3


def test_angles_are_kept_as_sliders_have_them(arm):
    desk = Desk(arm)
    desk.set_q_deg(np.array([60.0, -30.0, -20.0, 10.0, 0.0, 360.0]))
    np.testing.assert_allclose(np.degrees(desk.q), [60, 330, 20, 190, 0, 360], atol=1e-9)
    wanted = np.radians([60.0, -30.0, -20.0, 10.0, 0.0, 0.0])
    np.testing.assert_allclose(desk.tool, muxjax.forward_kinematics(arm, wanted), atol=1e-12)


def test_the_desk_refuses_and_stays_as_it_was(arm):
    desk = Desk(arm)
    desk.set_q_deg(np.degrees(Q))
    before = desk.displacements.copy()
    with pytest.raises(ValueError, match="segment 1 is 181 degrees, limit 180"):
        desk.set_q_deg(np.array([181.0, 0, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="tendon 1 is at 500 mm"):
        desk.set_tendons_mm(np.array([500.0, *[0.0] * 8]))
    with pytest.raises(ValueError, match="no reachable target"):
        desk.plan("exact")
    far = np.eye(4)
    far[:3, 3] = 0.0, 0.0, 2.0
    with pytest.raises(ValueError, match="not reached"):
        desk.solve(far)
    np.testing.assert_array_equal(desk.displacements, before)
    desk.solve(desk.tool)
    desk.failed[:] = True
    with pytest.raises(ValueError, match="every servo is marked as failed"):
        desk.plan("exact")


def test_all_solutions_are_found_and_the_chosen_one_is_planned_to(arm):
    desk = Desk(arm)
    pose = muxjax.forward_kinematics(arm, Q)
    assert desk.solve(pose) == "2 configurations reach the target"
    desk.axial = 5
    for k, q in enumerate(desk.solutions):
        np.testing.assert_allclose(muxjax.forward_kinematics(arm, q), pose, atol=1e-8)
        desk.chosen = k
        track = desk.plan("reverse")
        assert track.at(0.0).slot == 5  # from where the drum stands
        end = muxjax.forward_kinematics(
            arm, muxjax.configuration_from_tendons(arm, track.at(1e9).displacements)
        )
        np.testing.assert_allclose(end, pose, atol=1e-6)
    assert list(desk.tracks) == [
        "reverse, solution 1, servos 1 2 3",
        "reverse, solution 2, servos 1 2 3",
    ]


def test_solutions_in_collision_are_left_out(arm):
    world = load_world("cabinet")
    desk = Desk(arm, world)
    blocked = np.radians([100.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert clearance_of(arm, muxjax.tendon_displacements(arm, blocked), world) < 0
    with pytest.raises(ValueError, match="all collide; move the target"):
        desk.solve(muxjax.forward_kinematics(arm, blocked))
    assert not len(desk.solutions)
    desk.solve(muxjax.forward_kinematics(arm, Q))
    assert len(desk.solutions)
    for q in desk.solutions:
        assert clearance_of(arm, muxjax.tendon_displacements(arm, q), world) > 0


def test_the_nearest_solution_is_checked_for_collision_too(arm, monkeypatch):
    none = SimpleNamespace(q=np.zeros((0, 6)), mask=np.zeros(0, bool), complete=False)
    monkeypatch.setattr("muxjax.viz.desk.all_ik", lambda *_, **__: none)
    desk = Desk(arm, load_world("cabinet"))
    blocked = np.radians([100.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="all collide; move the target"):
        desk.solve(muxjax.forward_kinematics(arm, blocked))
    assert not len(desk.solutions)


# The controls, without a browser


@pytest.fixture
def viewer(arm):
    made = Viewer(Desk(arm), port=0)
    yield made
    made.stop()


def test_sliders_move_the_arm_and_each_other(arm, viewer):
    panel = viewer.panel
    panel.angles[0].value = 45.0
    wanted = muxjax.tendon_displacements(arm, np.radians([45.0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(viewer.desk.displacements, wanted)
    np.testing.assert_allclose([s.value for s in panel.tendons], 1e3 * wanted, atol=0.051)
    panel.tendons[0].value -= 5.0
    assert panel.angles[0].value > 45.0
    np.testing.assert_allclose(viewer.desk.displacements[1:], wanted[1:])
    tip = viewer.left.discs.batched_positions[-1]
    np.testing.assert_allclose(tip, muxjax.backbone(arm, viewer.desk.q, 1)[-1, :3, 3], atol=1e-6)
    panel.straighten.value = True
    assert not viewer.desk.displacements.any()


def test_what_cannot_be_is_refused_and_the_slider_goes_back(viewer):
    panel = viewer.panel
    panel.tendons[0].value = -90.0
    panel.tendons[1].value = 90.0
    assert panel.status.content.startswith("**Not done.** tendons: ")
    assert "limit 180" in panel.status.content
    assert [s.value for s in panel.tendons[:2]] == [-90.0, 0.0]
    panel.straighten.value = True
    panel.angles[0].value = 10.0
    assert viewer.desk.q[0] == pytest.approx(np.radians(10.0))
    panel.play.value = True
    assert "nothing to play" in panel.status.content


def test_a_slider_that_is_further_on_already_is_not_put_back(viewer, monkeypatch):
    slider, bend = viewer.panel.angles[0], viewer.desk.set_q_deg

    def slowly(q_deg):
        bend(q_deg)
        slider._impl.value = 31.0  # the browser has moved it on; that will act in its turn

    monkeypatch.setattr(viewer.desk, "set_q_deg", slowly)
    slider.value = 30.0
    assert slider.value == 31.0
    assert viewer.panel.tendons[0].value < 0  # the others follow


def test_a_frame_does_not_take_back_where_a_person_has_put_the_time(arm, program, viewer):
    viewer.desk.tracks["mine"] = track_of_program(arm, program, "mine")
    viewer.show_tracks(["mine"])
    viewer.panel.play.value = True
    person = threading.Thread(target=setattr, args=(viewer.panel.time, "value", 5.0))
    with viewer._lock:  # as while a frame is drawn
        person.start()
        _until(lambda: viewer.panel.time.value == 5.0, "the slider was not moved")
        time.sleep(0.05)
        viewer.tick(0.1)
    person.join()
    assert viewer.time_s == viewer.panel.time.value == 5.0
    assert not viewer.playing


def test_dragging_solves_for_the_last_place_only(arm, viewer):
    pose = muxjax.forward_kinematics(arm, Q)
    viewer.drag((9.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    viewer.drag(pose[:3, 3], _wxyz(pose))
    viewer.tick(0.0)
    assert "2 configurations" in viewer.panel.status.content
    assert len(viewer.panel.solution.options) == 2
    np.testing.assert_allclose(viewer.panel.position.value, 1e3 * pose[:3, 3], atol=0.01)
    viewer.panel.solution.value = viewer.panel.solution.options[1]
    assert viewer.desk.chosen == 1
    viewer.drag((0.0, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0))
    viewer.tick(0.0)
    assert "not reached" in viewer.panel.status.content
    assert viewer.panel.solution.value == "none"


def test_a_position_alone_is_reached_where_the_pose_is_not(arm, viewer):
    viewer.drag((0.04, 0.0, 0.44), (0.0, 1.0, 0.0, 0.0))  # pointing down
    viewer.tick(0.0)
    assert "not reached" in viewer.panel.status.content
    viewer.panel.goal.value = "position"
    assert "configurations reach the target (there may be more)" in viewer.panel.status.content
    assert 1 < len(viewer.desk.solutions) <= 8
    tools = muxjax.forward_kinematics(arm, viewer.desk.solutions)
    np.testing.assert_allclose(
        tools[:, :3, 3], np.tile([0.04, 0.0, 0.44], (len(tools), 1)), atol=1e-9
    )


def test_a_plan_to_a_position_keeps_target_and_solutions(arm, viewer):
    viewer.panel.goal.value = "position"
    viewer.drag((0.04, 0.0, 0.44), (0.0, 1.0, 0.0, 0.0))
    viewer.tick(0.0)
    many = len(viewer.desk.solutions)
    viewer.panel.method.value = "reverse"
    viewer.panel.plan.value = True
    assert viewer.shown_tracks[0] is not None
    np.testing.assert_allclose(viewer.desk.target[:3, 2], [0, 0, -1])  # as it was dragged
    assert len(viewer.desk.solutions) == many > 1
    viewer.choose(1)
    viewer.panel.plan.value = True
    assert [name[:19] for name in viewer.desk.tracks] == [f"reverse, solution {k}" for k in (1, 2)]


def test_a_solution_that_is_gone_is_not_chosen(arm, viewer):
    viewer.solve(muxjax.forward_kinematics(arm, Q))
    viewer.choose(2)  # there are two
    assert viewer.desk.chosen == 0
    viewer.choose(1)
    assert viewer.desk.chosen == 1


def test_where_the_arm_is_there_is_nothing_to_play(viewer):
    viewer.panel.to_tool.value = True
    viewer.panel.plan.value = True
    assert "0 stages" in viewer.panel.status.content
    assert "Press Play" not in viewer.panel.status.content


def test_a_mistake_in_a_control_is_said_and_the_others_go_on(viewer, monkeypatch):
    def broken(method):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(viewer.desk, "plan", broken)
    with pytest.raises(RuntimeError):
        viewer.panel.plan.value = True
    assert "out of memory" in viewer.panel.status.content
    assert not viewer.panel.plan.disabled
    viewer.panel.angles[0].value = 30.0
    assert viewer.desk.q[0] == pytest.approx(np.radians(30.0))


def test_a_plan_stays_if_the_one_beside_it_fails(arm, viewer, monkeypatch):
    viewer.solve(muxjax.forward_kinematics(arm, Q))
    plan = viewer.desk.plan

    def only_reverse(method):
        assert viewer.panel.plan.disabled
        if method != "reverse":
            raise ValueError(f"{method}: no")
        return plan(method)

    monkeypatch.setattr(viewer.desk, "plan", only_reverse)
    viewer.panel.method.value, viewer.panel.beside.value = "reverse", "greedy"
    viewer.panel.plan.value = True
    assert "greedy: no" in viewer.panel.status.content
    assert "reverse, solution 1, servos 1 2 3" in viewer.panel.left.options
    assert not viewer.panel.plan.disabled


def test_plan_play_and_compare(arm, viewer):
    panel, pose = viewer.panel, muxjax.forward_kinematics(arm, Q)
    panel.failed[1].value = True
    viewer.drag(pose[:3, 3], _wxyz(pose))
    viewer.tick(0.0)
    panel.beside.value = "reverse"
    panel.plan.value = True
    left, right = viewer.shown_tracks
    assert left.name == "exact, solution 1, servos 1 3"
    assert right.name == "reverse, solution 1, servos 1 3"
    assert viewer.right.root.visible
    assert (
        viewer.duration_s
        == max(left.duration_s, right.duration_s)
        == pytest.approx(panel.time.max, abs=0.006)
    )
    panel.speed.value = "10x"
    panel.play.value = True
    assert panel.play.label == "Pause"
    viewer.tick(1.0)
    assert viewer.time_s == pytest.approx(10.0)
    assert panel.time.value == pytest.approx(10.0)
    np.testing.assert_allclose(viewer.desk.displacements, left.at(10.0).displacements)
    viewer.tick(100.0)
    assert not viewer.playing
    np.testing.assert_allclose(viewer.desk.tool, pose, atol=1e-6)
    assert "0.0 mm from the target" in panel.readout.content
    panel.time.value = 5.0
    np.testing.assert_allclose(viewer.desk.displacements, left.at(5.0).displacements)
    panel.angles[0].value = 12.0  # by hand again
    assert (panel.left.value, panel.right.value) == (BY_HAND, NOTHING)
    assert not viewer.right.root.visible


def test_aiming_says_what_is_refused(arm, viewer):
    far = np.eye(4)
    far[:3, 3] = 0.0, 0.0, 2.0
    assert "not reached" in viewer.aim(far)
    viewer.panel.failed[0].value = viewer.panel.failed[1].value = True
    viewer.panel.failed[2].value = True
    assert "every servo is marked" in viewer.aim(muxjax.forward_kinematics(arm, Q))
    assert viewer.shown_tracks == (None, None)
    viewer.panel.failed[2].value = False
    assert viewer.aim(muxjax.forward_kinematics(arm, Q), "greedy") == ""
    assert [t.name[:6] for t in viewer.shown_tracks] == ["exact,", "greedy"]


def test_parts_can_be_hidden_and_tension_shown(viewer):
    panel = viewer.panel
    panel.shown["drum"].value = False
    assert not viewer.left.drum.visible
    panel.angles[0].value = 90.0
    thin = viewer.left._tendons[0].thickness
    panel.colour.value = "tension"
    assert "N (stiffness is assumed)" in panel.readout.content
    assert viewer.left._tendons[0].thickness != thin


def test_a_taken_port_is_said(arm):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ValueError, match=rf"127.0.0.1:{port} cannot be had"):
            Viewer(Desk(arm), port=port)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["nowhere.json"], "nowhere.json: no such file"),
        (["--servos", "4"], "servos 1 to 3, found 4"),
        (["--q-deg", "60", "0"], "--q-deg: muxarm has 3 segments; give 6 numbers"),
        (["--rpy-deg", "0", "0", "0"], "only --xyz-mm takes"),
        (["--beside", "greedy"], "--beside is of the plan"),
        (["--screenshot", "arm.jpg"], "must end in .png"),
        (["--size", "10", "10"], "must be 200 to 4000 pixels, found (10, 10)"),
        (["--world", "nowhere"], "no 'nowhere' among the shipped"),
        (["--preset", "nowhere"], "no 'nowhere' among the shipped"),
    ],
)
def test_bad_input_is_code_2(arguments, why, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(SystemExit) as stop:
        main(["view", *arguments])
    assert stop.value.code == 2
    assert why in capsys.readouterr().err


def test_a_time_after_the_timelines_end_is_said(arm, program, capsys, monkeypatch, tmp_path):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "run", interrupted)
    path = tmp_path / "program.json"
    save_program(program, path)
    ends = track_of_program(arm, program, "").duration_s
    for at_s, said in ((500, True), (1, False)):
        with pytest.raises(SystemExit) as end:
            main(["view", str(path), "--at-s", str(at_s), "--port", "0"])
        assert end.value.code == 0
        found = f"--at-s {at_s}: the timeline ends at {ends:.2f} s" in capsys.readouterr().err
        assert found == said


def test_a_missing_browser_is_said(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(NoBrowserError, match="no chromium and no chromedriver on the PATH"):
        find_browser()


def _wxyz(pose):
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)


# In a real browser


def _browser_or_why() -> str:
    try:
        find_browser()
    except NoBrowserError as error:
        return str(error)
    return ""


def _until(true, what: str) -> None:
    deadline = time.monotonic() + 30
    while not true():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.skipif(bool(_browser_or_why()), reason=_browser_or_why() or "has a browser")
def test_in_chromium_sliders_boxes_plan_and_play_act(arm, viewer):
    from io import BytesIO

    from PIL import Image
    from selenium.webdriver.common.keys import Keys

    def pixels(png: bytes) -> np.ndarray:
        picture = np.asarray(Image.open(BytesIO(png)).convert("L"), float)
        return picture[:, : int(0.7 * picture.shape[1])]  # without the panel

    pose = muxjax.forward_kinematics(arm, Q)
    with headless_browser(1000, 700) as browser:
        open_viewer(browser, viewer)
        first = pixels(settle(browser))
        assert first.std() > 10  # not blank
        thumb = browser.find_elements("css selector", "[role=slider]")[0]
        thumb.send_keys(*[Keys.ARROW_RIGHT] * 5)
        # All five steps of 0.1 degrees: a later one would take back what is set below.
        wanted = pytest.approx(np.radians(0.5))
        _until(lambda: viewer.desk.q[0] == wanted, "the slider did not bend the arm")
        assert viewer.desk.displacements[0] < 0
        viewer.panel.angles[0].value = 60.0
        second = pixels(settle(browser))
        assert np.abs(second - first).mean() > 0.3  # the picture has changed
        boxes = browser.find_elements("css selector", "input[type=checkbox]")
        [box for box in boxes if box.is_displayed()][1].click()
        _until(lambda: viewer.desk.failed.tolist() == [False, True, False], "no servo failed")
        _until(lambda: viewer.left._crosses.visible, "no servo is crossed")
        viewer.drag(pose[:3, 3], _wxyz(pose))
        viewer.tick(0.0)
        press(browser, "Plan")
        time.sleep(0.3)
        press(browser, "Plan", among="button:not([role=tab])")
        _until(lambda: viewer.shown_tracks[0] is not None, "no plan was made")
        assert viewer.shown_tracks[0].name == "exact, solution 1, servos 1 3"
        press(browser, "Play")
        time.sleep(0.3)
        press(browser, "Play", among="button:not([role=tab])")
        _until(lambda: viewer.playing, "it does not play")
        viewer.tick(12.0)
        assert viewer.time_s == pytest.approx(12.0)
        third = pixels(settle(browser))
        assert np.abs(third - second).mean() > 0.3
        severe = [e for e in browser.get_log("browser") if e["level"] == "SEVERE"]
        assert not severe
