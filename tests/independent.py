"""M Eq. 1, 2 and 4-6 once more, in scalar NumPy loops and polar form, as MODEL.md corrects them.

Nothing is shared with muxjax but the robot's numbers. Quotients by theta have explicit limits at
theta = 0; elsewhere they are written so that nothing cancels.
"""

from __future__ import annotations

import math

import numpy as np

from muxjax.robot import Robot


def rot_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rot_y(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rot_z_slope(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[-s, -c, 0.0], [c, -s, 0.0], [0.0, 0.0, 0.0]])


def rot_y_slope(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[-s, 0.0, c], [0.0, 0.0, 0.0], [-c, 0.0, -s]])


def sideways(theta: float) -> float:
    """(1 - cos theta) / theta."""
    return 0.0 if theta == 0 else 2 * math.sin(theta / 2) ** 2 / theta


def upwards(theta: float) -> float:
    """sin theta / theta."""
    return 1.0 if theta == 0 else math.sin(theta) / theta


def sideways_slope(theta: float) -> float:
    """(theta sin theta - (1 - cos theta)) / theta^2."""
    if theta == 0:
        return 0.5
    return (theta * math.sin(theta) - 2 * math.sin(theta / 2) ** 2) / theta**2


def upwards_slope(theta: float) -> float:
    """(theta cos theta - sin theta) / theta^2; its terms cancel below 0.05."""
    if abs(theta) < 0.05:
        return -theta / 3 + theta**3 / 30 - theta**5 / 840 + theta**7 / 45360
    return (theta * math.cos(theta) - math.sin(theta)) / theta**2


def segment(theta: float, phi: float, length: float) -> np.ndarray:
    """M Eq. 1."""
    pose = np.eye(4)
    pose[:3, :3] = rot_z(phi) @ rot_y(theta) @ rot_z(-phi)
    side = sideways(theta)
    pose[:3, 3] = [
        length * math.cos(phi) * side,
        length * math.sin(phi) * side,
        length * upwards(theta),
    ]
    return pose


def segment_by_theta(theta: float, phi: float, length: float) -> np.ndarray:
    slope = np.zeros((4, 4))
    slope[:3, :3] = rot_z(phi) @ rot_y_slope(theta) @ rot_z(-phi)
    side = sideways_slope(theta)
    slope[:3, 3] = [
        length * math.cos(phi) * side,
        length * math.sin(phi) * side,
        length * upwards_slope(theta),
    ]
    return slope


def segment_by_phi(theta: float, phi: float, length: float) -> np.ndarray:
    slope = np.zeros((4, 4))
    slope[:3, :3] = rot_z_slope(phi) @ rot_y(theta) @ rot_z(-phi)
    slope[:3, :3] -= rot_z(phi) @ rot_y(theta) @ rot_z_slope(-phi)
    side = sideways(theta)
    slope[:3, 3] = [-length * math.sin(phi) * side, length * math.cos(phi) * side, 0.0]
    return slope


def pose(robot: Robot, q: np.ndarray) -> np.ndarray:
    """M Eq. 2 between the base and the tool frame."""
    return chain(robot, [segment(q[2 * i], q[2 * i + 1], L) for i, L in enumerate(robot.length)])


def chain(robot: Robot, factors: list[np.ndarray]) -> np.ndarray:
    product = np.array(robot.base)
    for factor in factors:
        product = product @ factor
    return product @ robot.tool


def backbone(robot: Robot, q: np.ndarray, n: int) -> np.ndarray:
    """Frames at equal arc length: a part of an arc bends and is long in proportion."""
    start = np.array(robot.base)
    frames = [start]
    for i, length in enumerate(robot.length):
        for k in range(1, n + 1):
            frames.append(start @ segment(q[2 * i] * k / n, q[2 * i + 1], length * k / n))
        start = frames[-1]
    return np.array(frames)


def jacobian(robot: Robot, q: np.ndarray, frame: str) -> np.ndarray:
    """Columns (linear, angular) from the product rule on M Eq. 2."""
    factors = [segment(q[2 * i], q[2 * i + 1], L) for i, L in enumerate(robot.length)]
    tip = chain(robot, factors)
    columns = []
    for i, length in enumerate(robot.length):
        for slope in (segment_by_theta, segment_by_phi):
            varied = [*factors[:i], slope(q[2 * i], q[2 * i + 1], length), *factors[i + 1 :]]
            velocity = chain(robot, varied)
            spin = velocity[:3, :3] @ tip[:3, :3].T  # [omega] in the world
            linear = velocity[:3, 3]
            angular = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
            if frame == "body":
                linear = tip[:3, :3].T @ linear
            if frame in ("body", "mixed"):
                angular = tip[:3, :3].T @ angular
            columns.append(np.concatenate([linear, angular]))
    return np.array(columns).T


def tendon_term(robot: Robot, theta: float, phi: float, n: int, azimuth: float) -> float:
    """One term of M Eq. 6: a tendon's length change inside segment n."""
    xi, length, radius = robot.n_discs[n], robot.length[n], float(robot.tendon_radius)
    if theta == 0:
        return 0.0
    chords = 2 * xi * math.sin(theta / (2 * xi))
    # A L / theta - L = L (A / theta - 1), which cancels for small theta
    half = theta / (2 * xi)
    shortening = math.sin(half) / half - 1 if half > 1e-2 else -(half**2) / 6 + half**4 / 120
    return length * shortening - chords * radius * math.cos(azimuth - phi)


def tendons(robot: Robot, q: np.ndarray) -> np.ndarray:
    """M Eq. 6 with the azimuth table of MODEL.md section 3."""
    out = []
    for i in range(robot.n_segments):
        for j in range(robot.tendons_per_segment):
            total = 0.0
            for n in range(i + 1):
                psi = robot.tendon_azimuth[n, i, j]
                total += tendon_term(robot, q[2 * n], q[2 * n + 1], n, psi)
            out.append(total)
    return np.array(out)


def configuration(robot: Robot, lengths: np.ndarray) -> np.ndarray:
    """M Eq. 4-5 with the proximal segments subtracted and both signs of Eq. 4 flipped."""
    j = robot.tendons_per_segment
    q: list[float] = []
    for i in range(robot.n_segments):
        own = [float(x) for x in lengths[j * i : j * (i + 1)]]
        for n in range(i):
            for k in range(j):
                psi = robot.tendon_azimuth[n, i, k]
                own[k] -= tendon_term(robot, q[2 * n], q[2 * n + 1], n, psi)
        solve = triad if j == 3 else harmonic
        q.extend(
            solve(own, robot.length[i], float(robot.tendon_radius), robot.tendon_azimuth[i, i])
        )
    return np.array(q)


def triad(d: list[float], length: float, radius: float, azimuth: np.ndarray) -> tuple[float, float]:
    """M Eq. 4-5 letter by letter, but for the signs."""
    local = math.atan2(-math.sqrt(3) * (d[1] - d[2]), -(2 * d[0] - d[1] - d[2]))
    root = math.sqrt(3 * (d[1] - d[2]) ** 2 + 3 * (d[1] + d[2] - 2 * d[0]) ** 2)
    below = radius * math.sqrt(1 + 2 * math.cos(local) ** 2) * (3 * length + sum(d))
    return root * length / below, (local + azimuth[0]) % (2 * math.pi)


def harmonic(
    d: list[float], length: float, radius: float, azimuth: np.ndarray
) -> tuple[float, float]:
    """The same for any number of tendons: mean and first harmonic."""
    m = (
        2
        / len(d)
        * sum(x * complex(math.cos(a), math.sin(a)) for x, a in zip(d, azimuth, strict=True))
    )
    phi = math.atan2(-m.imag, -m.real) % (2 * math.pi)
    return abs(m) * length / (radius * (sum(d) / len(d) + length)), phi


def bending(q: np.ndarray) -> np.ndarray:
    """theta (cos phi, sin phi) of each segment: what to compare where phi has no meaning."""
    theta, phi = q[..., 0::2], q[..., 1::2]
    return np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1)


def rotation_angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two rotations from the chord |a - b| = sqrt(8) sin(angle / 2)."""
    return 2 * math.asin(min(1.0, float(np.linalg.norm(a - b)) / math.sqrt(8)))
