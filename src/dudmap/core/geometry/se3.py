"""Rigid motions as 4x4 float64 matrices.

``T_a_b`` maps points of frame b into frame a: ``p_a = T_a_b @ p_b``. A twist is ``xi = (v, omega)``, translation first,
in metres and radians. Updates are applied on the left, ``exp(xi) @ T``.
"""

import math

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import FrameError

Matrix = NDArray[np.float64]
IDENTITY = np.eye(3)
SMALL = 1e-8
"""Squared angle below which the Taylor series is used."""


def hat(omega: Matrix) -> Matrix:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3), with ``hat(a) @ b == cross(a, b)``."""
    out = np.zeros((*omega.shape, 3))
    out[..., (2, 0, 1), (1, 2, 0)] = omega
    out[..., (1, 2, 0), (2, 0, 1)] = -omega
    return out


def exp(xi: Matrix) -> Matrix:
    """Rigid motion (4, 4) of a twist (6,) after unit time (thesis eq. 4.30)."""
    xi = np.asarray(xi, dtype=np.float64)
    v, omega = xi[:3], xi[3:]
    theta_squared = float(omega @ omega)
    W = hat(omega)
    if theta_squared < 1e-8:  # Taylor series: the closed forms are 0/0 here
        a, b, c = 1 - theta_squared / 6, 0.5 - theta_squared / 24, 1 / 6 - theta_squared / 120
    else:
        theta = np.sqrt(theta_squared)
        a = np.sin(theta) / theta
        b = (1 - np.cos(theta)) / theta_squared
        c = (1 - a) / theta_squared
    WW = W @ W
    T = np.eye(4)
    T[:3, :3] += a * W + b * WW
    T[:3, 3] = v + b * (W @ v) + c * (WW @ v)
    return T


def exp_all(twists: Matrix) -> Matrix:
    """Rigid motions (n, 4, 4) of twists (n, 6), see ``exp``."""
    v, omega = twists[:, :3, None], twists[:, 3:]
    theta_squared = np.sum(omega * omega, axis=1)[:, None, None]
    W = hat(omega)
    small = theta_squared < 1e-8  # Taylor series: the closed forms are 0/0 there
    square = np.where(small, 1.0, theta_squared)
    theta = np.sqrt(square)
    a = np.where(small, 1 - theta_squared / 6, np.sin(theta) / theta)
    b = np.where(small, 0.5 - theta_squared / 24, (1 - np.cos(theta)) / square)
    c = np.where(small, 1 / 6 - theta_squared / 120, (1 - a) / square)
    WW = W @ W
    T = np.tile(np.eye(4), (len(twists), 1, 1))
    T[:, :3, :3] += a * W + b * WW
    T[:, :3, 3:] = v + b * (W @ v) + c * (WW @ v)
    return T


def exp_rotation(omega: Matrix) -> Matrix:
    """Rotation matrix (3, 3) of a rotation vector (3,), radians (Rodrigues)."""
    return np.array(rodrigues(*(float(value) for value in omega))).reshape(3, 3)


def rodrigues(x: float, y: float, z: float) -> tuple[float, ...]:
    """Rotation matrix, row by row, of a rotation vector, radians; back ends compile it."""
    theta_squared = x * x + y * y + z * z
    a, b = 1 - theta_squared / 6, 0.5 - theta_squared / 24  # Taylor series: the closed forms are 0/0 at 0
    if theta_squared >= SMALL:
        theta = math.sqrt(theta_squared)
        a, b = math.sin(theta) / theta, (1 - math.cos(theta)) / theta_squared
    return (
        1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y,
        b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x,
        b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y),
    )  # fmt: skip


def log(T: Matrix) -> Matrix:
    """Twist (6,) whose exponential is ``T`` (4, 4); the rotation angle lies in [0, pi]."""
    omega = log_rotation(T[:3, :3])
    theta_squared = float(omega @ omega)
    W = hat(omega)
    if theta_squared < 1e-8:
        c = 1 / 12 + theta_squared / 720
    else:
        theta = np.sqrt(theta_squared)
        c = (1 - theta * np.cos(theta / 2) / (2 * np.sin(theta / 2))) / theta_squared
    out = np.empty(6)
    out[:3], out[3:] = (IDENTITY - 0.5 * W + c * (W @ W)) @ T[:3, 3], omega
    return out


def log_all(Ts: Matrix) -> Matrix:
    """Twists (n, 6) of rigid motions (n, 4, 4), see ``log``."""
    omega, sine, cosine = _turns(Ts[:, :3, :3])
    omega *= np.where(sine < 1e-12, 0.5, np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]
    for n in np.flatnonzero(cosine < 0).tolist():  # near half a turn the sine vanishes
        omega[n] = log_rotation(Ts[n, :3, :3])
    theta_squared = np.sum(omega * omega, axis=1)
    small = theta_squared < 1e-8
    square = np.where(small, 1.0, theta_squared)
    theta = np.sqrt(square)
    c = np.where(
        small, 1 / 12 + theta_squared / 720, (1 - theta * np.cos(theta / 2) / (2 * np.sin(theta / 2))) / square
    )
    W = hat(omega)
    V_inverse = np.eye(3) - 0.5 * W + c[:, None, None] * (W @ W)
    return np.concatenate([(V_inverse @ Ts[:, :3, 3:])[..., 0], omega], axis=1)


def log_rotation(R: Matrix) -> Matrix:
    """Rotation vector (3,) of a rotation matrix (3, 3), exact up to and at half a turn."""
    x, y, z, w = rotation_to_quat_xyzw(R)
    vector = np.array([x, y, z])
    sine = math.sqrt(vector @ vector)
    if sine < 1e-12:
        return 2.0 * vector
    return vector * (2.0 * np.arctan2(sine, w) / sine)


def inverse(T: Matrix) -> Matrix:
    """Inverse of rigid motions (..., 4, 4): ``inverse(T) @ T == identity``."""
    R_t = T[:3, :3].T if T.ndim == 2 else T[..., :3, :3].swapaxes(-1, -2)
    out = np.zeros(T.shape, T.dtype)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def rotation_angle(T: Matrix) -> float:
    """Angle in radians, in [0, pi], of the rotation of ``T`` (4, 4) or (3, 3)."""
    vector = log_rotation(T[:3, :3])
    return math.sqrt(vector @ vector)


def rotation_angles(Ts: Matrix) -> Matrix:
    """Angles (n,) in radians, in [0, pi], of the rotations of ``Ts`` (n, 4, 4) or (n, 3, 3)."""
    _, sine, cosine = _turns(Ts[:, :3, :3])
    return np.arctan2(sine, cosine)


def _turns(R: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    axes = R[:, [2, 0, 1], [1, 2, 0]] - R[:, [1, 2, 0], [2, 0, 1]]
    return axes, np.linalg.norm(axes, axis=1), np.trace(R, axis1=1, axis2=2) - 1


def interpolate(T_a: Matrix, T_b: Matrix, share: float) -> Matrix:
    """Motion on the screw from ``T_a`` (0) to ``T_b`` (1)."""
    return T_a @ exp(share * log(inverse(T_a) @ T_b))


def rotation_to_quat_xyzw(R: Matrix) -> Matrix:
    """Unit quaternion (4,) in the order x, y, z, w with w >= 0 (Shepperd 1978: divide by the largest component)."""
    x, y, z = R[0, 0], R[1, 1], R[2, 2]
    trace = x + y + z
    q = np.empty(4)
    if trace > x and trace > y and trace > z:
        q[3] = 1 + trace
        q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = 0 if x >= y and x >= z else 1 if y >= z else 2
        j, m = (i + 1) % 3, (i + 2) % 3
        q[i] = 1 + 2 * R[i, i] - trace
        q[j] = R[j, i] + R[i, j]
        q[m] = R[m, i] + R[i, m]
        q[3] = R[m, j] - R[j, m]
    q /= math.sqrt(q @ q)
    return -q if q[3] < 0 else q


def quat_xyzw_to_rotation(quat_xyzw: Matrix) -> Matrix:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), x, y, z, w, of any length."""
    quats = np.asarray(quat_xyzw, dtype=np.float64)
    x, y, z, w = np.moveaxis(quats / np.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def nearest_rotation(R: Matrix) -> Matrix:
    """Closest rotations to ``R`` (..., 3, 3) in the Frobenius norm."""
    U, _, V_t = np.linalg.svd(R)
    U[..., 2] *= np.sign(np.linalg.det(U @ V_t))[..., None]
    return U @ V_t


def retract(T_world_camera: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pose after a twist (v, omega) about the camera's centre, world axes."""
    out = T_world_camera.copy()
    out[:3, :3] = exp_rotation(step[3:]) @ T_world_camera[:3, :3]
    out[:3, 3] += step[:3]
    return out


def adjoint(T: Matrix) -> Matrix:
    """Adjoints (..., 6, 6) of rigid motions (..., 4, 4): ``T exp(xi) T^-1 == exp(adjoint(T) xi)``."""
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = T[..., :3, :3]
    out[..., :3, 3:] = hat(T[..., :3, 3]) @ T[..., :3, :3]
    return out


def small_adjoint(xi: Matrix) -> Matrix:
    """Adjoints (..., 6, 6) of twists (..., 6): the derivative of ``adjoint(exp(t xi))`` at t = 0."""
    out = np.zeros((*xi.shape[:-1], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = hat(xi[..., 3:])
    out[..., :3, 3:] = hat(xi[..., :3])
    return out


def interpolate_in_time(timestamps: Matrix, Ts: Matrix, timestamp: float) -> Matrix:
    """Motion (4, 4) at a time on the screw between its neighbours; the nearest one outside the range.

    Args:
        timestamps: (n,) increasing, n > 0.
        Ts: (n, 4, 4).
        timestamp: The time.
    """
    after = int(np.searchsorted(timestamps, timestamp))
    if after == len(timestamps):
        return Ts[-1]
    if after == 0 or timestamps[after] == timestamp:
        return Ts[after]
    start, end = timestamps[after - 1], timestamps[after]
    return interpolate(Ts[after - 1], Ts[after], (timestamp - start) / (end - start))


def difference(T_a: NDArray[np.float64], T_b: NDArray[np.float64]) -> tuple[float, float]:
    """Distance (m) and angle (deg) between two poses (4, 4)."""
    apart = T_a[:3, 3] - T_b[:3, 3]
    return math.sqrt(apart @ apart), math.degrees(rotation_angle(T_a[:3, :3].T @ T_b[:3, :3]))


def agree(T_a: NDArray[np.float64], T_b: NDArray[np.float64], distance: float, angle_deg: float) -> bool:
    """Whether two poses (4, 4) differ by less than a distance (m) and an angle (deg)."""
    apart, turned = difference(T_a, T_b)
    return apart < distance and turned < angle_deg


LARGEST_SKEW = 0.02
"""Error of the products of a rotation's rows that rounding to two digits explains."""


def checked_pose(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Check that a given pose (4, 4) is a rigid motion, and orthonormalise its rotation.

    Raises:
        FrameError: It is not a rigid motion.
    """
    T = np.array(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.all(np.isfinite(T)):
        raise FrameError(f"the given pose has the shape {T.shape}; expected (4, 4) finite numbers, camera to world")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > LARGEST_SKEW or np.linalg.det(R) < 0 or np.any(T[3] != (0, 0, 0, 1)):
        raise FrameError("the given pose is not a rigid motion; expected a rotation and metres, camera to world")
    T[:3, :3] = nearest_rotation(R)
    return T
