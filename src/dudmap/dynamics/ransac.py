"""The one rigid motion that explains most of what is seen (RANSAC, Fischler and Bolles 1981)."""

import numpy as np
from numpy.typing import NDArray

from dudmap.geometry import se3
from dudmap.geometry.camera import Camera
from dudmap.kernels import consensus
from dudmap.kernels.threads import bands, run_bands

NOISE_PX = 0.7
"""A corner fits a motion if it lies within this of where the motion puts it, pixels."""
GUESSES = 150
NEAR_PX = 5.0
"""A motion that takes what is seen this far away from where it was expected, in pixels, is less likely by a quarter."""


def rigid_motion(
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    say: NDArray[np.float64],
    camera: Camera,
    T_expected: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Motion (4, 4) that brings most surface to its target pixels.

    Three corners give the six numbers of a small motion, linearly (Longuet-Higgins and Prazdny 1980); of many such
    guesses the one that explains most surface, counted as in MSAC (Torr and Zisserman 2000), is refined on all
    corners that follow it, with the exact projection. A crowd that walks abreast may show more surface than the world
    behind it, and no image can tell which of the two moves; so what a motion explains counts up to twice, the nearer
    the motion is to what is expected, which is a guess too.

    Args:
        points: (n, 3) metres, first camera's frame.
        targets: (n, 2) their pixels in the second image.
        say: (n,) what each of them counts; the surface it stands for grows with the square of its depth besides.
        camera: Camera of both images.
        T_expected: (4, 4) what the motion should be.
    """
    surface = say * points[:, 2] ** 2
    start, expected = (projected(T, points, camera) for T in (np.eye(4), T_expected))
    flow, J = targets - start, flow_jacobian(points, camera)
    rng = np.random.default_rng(0)
    n = len(points)
    draws = np.concatenate([
        rng.integers(0, n, (GUESSES, 3)),
        rng.choice(n, (GUESSES, 3), p=surface / surface.sum()),
    ])  # fmt: skip
    A = J[draws].reshape(-1, 6, 6)
    A = A + 1e-9 * np.eye(6)  # corners drawn twice define nothing; such guesses explain nothing either
    guesses = np.linalg.solve(A, flow[draws].reshape(-1, 6, 1))[..., 0]
    guesses = np.ascontiguousarray(guesses[np.linalg.norm(guesses, axis=1) < 0.5])
    by_axis, flow_by_axis = np.ascontiguousarray(J.transpose(1, 2, 0)), np.ascontiguousarray(flow.T)
    usual = np.ascontiguousarray((expected - start).T)
    explained = np.zeros(len(guesses) + 1)
    run_bands(
        lambda start, stop: consensus.msac_scores(
            start, stop, guesses, by_axis, flow_by_axis, usual, surface, NOISE_PX, NEAR_PX, explained
        ),
        bands(len(guesses), 64),
    )
    best = int(np.argmax(explained))
    candidates = [T_expected] if best == len(guesses) else [T_expected, se3.exp(guesses[best])]
    refined = [_refined(T, points, targets, say, camera) for T in candidates]
    return max(refined, key=lambda T: _score(projected(T, points, camera), targets, expected, surface))


def _refined(
    T: NDArray[np.float64],
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    say: NDArray[np.float64],
    camera: Camera,
) -> NDArray[np.float64]:
    """Motion that fits best, in least squares, what one near it explains; arguments as above."""
    H, gradient = np.empty((6, 6)), np.empty(6)
    for scale in (3.0, 2.0, 1.0, 1.0, 1.0):
        if consensus.refinement(points, targets, say, T, camera.intrinsics, scale * NOISE_PX, H, gradient) < 6:
            break
        T = se3.exp(np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), gradient)) @ T
    return T


def _score(
    found: NDArray[np.float64],
    targets: NDArray[np.float64],
    expected: NDArray[np.float64],
    surface: NDArray[np.float64],
) -> float:
    """What a motion that brings points to these pixels (n, 2) explains, by how likely it is."""
    error = np.sum((found - targets) ** 2, axis=1) / NOISE_PX**2
    away = np.linalg.norm(found - expected, axis=1).mean() / NEAR_PX
    return float((surface * (1 - np.minimum(error, 1))).sum() * (0.5 + 0.5 / (1 + away**2)))


def flow_jacobian(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Change (n, 2, 6) of the pixels of points (n, 3) by a small twist (v, omega) of theirs."""
    z = np.maximum(points[:, 2], 1e-6)
    x, y, one, zero = points[:, 0] / z, points[:, 1] / z, np.ones_like(z), np.zeros_like(z)
    du = camera.fx * np.stack([one / z, zero, -x / z, -x * y, 1 + x * x, -y], axis=1)
    dv = camera.fy * np.stack([zero, one / z, -y / z, -1 - y * y, x * y, x], axis=1)
    return np.stack([du, dv], axis=1)


def projected(T: NDArray[np.float64], points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Pixels (n, 2) of moved points (n, 3)."""
    moved = points @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(moved[:, 2], 1e-6)
    return np.stack([camera.fx * moved[:, 0] / z + camera.cx, camera.fy * moved[:, 1] / z + camera.cy], axis=1)
