"""The robot as a pytree: what the formulas need, in SI units."""

from __future__ import annotations

import hashlib
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from muxjax.config import FrameConfig, RobotConfig, load_yaml, resolve

Array = jax.Array | np.ndarray
Scalar = Float[Array, ""] | float


class Robot(eqx.Module):
    """A time-multiplexed tendon arm.

    The leaves are float64 NumPy arrays, so one robot serves float32 and float64 code alike and
    any of them can be differentiated or swept. ``config`` is static: counts, the axial map and
    whatever only the hardware needs.
    """

    length: Float[Array, " S"]  # L_i [m]
    theta_max: Float[Array, " S"]  # [rad]
    tendon_radius: Float[Array, ""]  # r_a [m]
    tendon_azimuth: Float[Array, "S S J"]  # psi[n, i, j] [rad], used for n <= i
    body_radius: Float[Array, ""]  # outer radius of the discs [m]
    base: Float[Array, "4 4"]  # pose of the arm's root in the world
    tool: Float[Array, "4 4"]  # pose of the tool in the last disc's frame
    gear_ratio: Float[Array, ""]  # servo turns a wheel turn
    wheel_radius: Float[Array, ""]  # r_w [m]
    servo_speed: Float[Array, ""]  # omega [rad/s] at the servo's shaft
    switch_time: Float[Array, ""]  # t_sw: repositioning and engagement [s]
    engage_time: Float[Array, ""]  # engagement alone, where the drum need not turn [s]
    config: RobotConfig = eqx.field(static=True)

    @property
    def fingerprint(self) -> str:
        """Hash over every value, by which plans, programs and boards name their robot.

        A robot whose leaves were changed is another robot, though its configuration is the same.
        """
        digest = hashlib.sha256(self.config.fingerprint.encode())
        for leaf in jax.tree.leaves(self):
            digest.update(np.asarray(leaf, dtype=np.float64).tobytes())
        return digest.hexdigest()[:16]

    @property
    def n_segments(self) -> int:
        """S."""
        return self.config.n_segments

    @property
    def tendons_per_segment(self) -> int:
        """J, also the number of radial servos."""
        return self.config.n_servos

    @property
    def n_tendons(self) -> int:
        """S * J."""
        return self.config.n_tendons

    @property
    def n_discs(self) -> np.ndarray:
        """xi_i, shape (S,)."""
        return np.array([s.n_discs.value for s in self.config.segments], dtype=np.float64)

    @property
    def axial_map(self) -> Int[np.ndarray, "A J"]:
        """F(a, s) = c of M Eq. 10, counting from 0."""
        return np.array(self.config.axial_map) - 1

    def reach(self, servos: tuple[int, ...]) -> Bool[np.ndarray, "A SJ"]:
        """Tendons that servos (counting from 1) meet at each axial position."""
        table = self.axial_map[:, [s - 1 for s in servos]]
        met = np.zeros((len(table), self.n_tendons), dtype=bool)
        np.put_along_axis(met, table, True, axis=1)
        return met

    @property
    def servo_per_metre(self) -> Scalar:
        """N = gear ratio / wheel radius [rad/m]: servo angle for a tendon displacement."""
        return self.gear_ratio / self.wheel_radius

    @property
    def tendon_speed(self) -> Scalar:
        """Fastest tendon displacement omega / N [m/s]."""
        return self.servo_speed / self.servo_per_metre


def load_robot(name_or_path: str | Path) -> Robot:
    """Read a robot: a shipped one by name (``"muxarm"``, ``"penta"``), or a YAML file by path.

    Raises:
        ConfigError: No such robot, or a file with wrong values; the message names each field's
            path, the value found and its limit.
    """
    return robot_from_config(load_yaml(RobotConfig, resolve(name_or_path, "robots")))


def robot_from_config(config: RobotConfig) -> Robot:
    """Robot of a validated configuration."""
    segments = config.segments
    return Robot(
        length=np.array([s.length_m.value for s in segments]),
        theta_max=np.deg2rad([s.theta_max_deg.value for s in segments]),
        tendon_radius=np.array(config.tendons.radius_m.value),
        tendon_azimuth=_azimuth_table(config),
        body_radius=np.array(config.body.disc_radius_m.value),
        base=frame_pose(config.base_frame),
        tool=frame_pose(config.tool_frame),
        gear_ratio=np.array(config.transmission.gear_ratio.value),
        wheel_radius=np.array(config.transmission.wheel_radius_m.value),
        servo_speed=np.array(config.servo.speed_rpm.value * 2 * np.pi / 60),
        switch_time=np.array(config.axial.switch_time_s.value),
        engage_time=np.array(config.axial.engage_time_s.value),
        config=config,
    )


def _azimuth_table(config: RobotConfig) -> Float[np.ndarray, "S S J"]:
    """psi[n, i, j]; MODEL.md section 3.

    "parallel": a tendon keeps its own azimuth, alpha_i + 2 pi j / J.
    "printed": Eq. 6 read to the letter, alpha_n + 2 pi j / J in every segment n it crosses.
    """
    s, j = config.n_segments, config.n_servos
    if config.tendons.azimuth_deg is not None:
        return np.deg2rad(np.array(config.tendons.azimuth_deg))
    alpha = np.deg2rad([segment.tendon_offset_deg.value for segment in config.segments])
    within = 2 * np.pi * np.arange(j) / j
    own = (
        alpha[None, :, None] if config.tendons.routing.value == "parallel" else alpha[:, None, None]
    )
    return np.broadcast_to(own + within, (s, s, j)).copy()


def frame_pose(frame: FrameConfig) -> Float[np.ndarray, "4 4"]:
    """Homogeneous transform [m] of a frame."""
    if not any(frame.xyz_m) and not any(frame.rpy_deg):
        return np.eye(4)  # most frames; scipy.spatial takes a fifth of a second to import
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", frame.rpy_deg, degrees=True)
    return scipy.spatial.transform.RigidTransform.from_components(frame.xyz_m, turn).as_matrix()
