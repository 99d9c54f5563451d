"""Pose graph optimization against problems whose solution is known."""

import numpy as np
from scipy.optimize import least_squares

from dudmap.core.geometry import se3
from dudmap.core.places.pose_graph import Edge, optimize


def random_pose(rng, reach=1.0):
    return se3.exp(np.concatenate([rng.uniform(-reach, reach, 3), rng.uniform(-1.5, 1.5, 3)]))


def chain(Ts, sigma=0.01):
    return [Edge(i, i + 1, se3.inverse(Ts[i]) @ Ts[i + 1], sigma, sigma) for i in range(len(Ts) - 1)]


def test_a_loop_without_contradiction_changes_nothing():
    rng = np.random.default_rng(2)
    Ts = np.stack([random_pose(rng) for _ in range(12)])
    edges = [*chain(Ts), Edge(0, 11, se3.inverse(Ts[0]) @ Ts[11], 0.01, 0.01)]
    np.testing.assert_allclose(optimize(Ts, edges), Ts, atol=1e-9)


def test_measurements_without_contradiction_are_met_from_afar():
    rng = np.random.default_rng(3)
    truth = np.stack([random_pose(rng) for _ in range(20)])
    truth = se3.inverse(truth[0]) @ truth
    pairs = [(i, i + 1) for i in range(19)] + [(0, 19), (3, 12), (7, 16)]
    edges = [Edge(a, b, se3.inverse(truth[a]) @ truth[b], 0.02, 0.01) for a, b in pairs]
    start = truth.copy()
    for T in start[1:]:
        T[:] = T @ se3.exp(rng.normal(0, 0.1, 6))
    np.testing.assert_allclose(optimize(start, edges), truth, atol=1e-8)


def test_a_gap_is_spread_by_the_variances():
    """A straight chain of n equal steps that ends g off: each variance v_i takes v_i / sum(v) of the gap."""
    sigma = np.array([0.01, 0.02, 0.01, 0.03, 0.01])
    Ts = np.tile(np.eye(4), (6, 1, 1))
    Ts[:, 0, 3] = np.arange(6.0)
    edges = [Edge(i, i + 1, se3.inverse(Ts[i]) @ Ts[i + 1], s, 1e-4) for i, s in enumerate(sigma)]
    measured = Ts[5].copy()
    measured[0, 3] -= 0.1
    edges.append(Edge(0, 5, measured, 0.005, 1e-4))
    variance = np.append(sigma**2, 0.005**2)
    expected = np.arange(6.0) - 0.1 * np.append(0, np.cumsum(sigma**2)) / variance.sum()
    Ts_new = optimize(Ts, edges)
    np.testing.assert_allclose(Ts_new[:, 0, 3], expected, atol=1e-9)
    np.testing.assert_allclose(Ts_new[:, 1:3, 3], 0, atol=1e-9)


def test_the_gap_of_a_drifting_circle_closes():
    rng = np.random.default_rng(4)
    step = se3.exp([0.1, 0, 0, 0, 0, 2 * np.pi / 40])
    truth = [np.eye(4)]
    for _ in range(40):
        truth.append(truth[-1] @ step)
    drift = [se3.exp(rng.normal([0.002, 0.001, 0, 0, 0, 0.003], 0.0005)) for _ in range(40)]
    drifted = [np.eye(4)]
    for error in drift:
        drifted.append(drifted[-1] @ step @ error)
    Ts = np.stack(drifted)
    edges = [*chain(Ts, 0.003), Edge(0, 40, np.eye(4), 0.001, 0.001)]
    corrected = optimize(Ts, edges)

    def worst(poses):
        return max(np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(poses, truth, strict=True))

    assert np.linalg.norm(Ts[40][:3, 3]) > 0.05
    assert np.linalg.norm(corrected[40][:3, 3]) < 0.005
    assert worst(corrected) < 0.5 * worst(Ts)


def test_a_large_contradiction_is_spread_as_by_least_squares():
    """Against SciPy's solution, with numerical derivatives, of a loop that ends 40 degrees off."""
    rng = np.random.default_rng(5)
    Ts = np.stack([np.eye(4), *(random_pose(rng) for _ in range(4))])
    gap = se3.exp(np.array([0.2, -0.1, 0.4, 0.4, 0.5, -0.3]))
    edges = [*chain(Ts, 0.05), Edge(0, 4, Ts[4] @ gap, 0.02, 0.01)]

    def moved(steps):
        return np.concatenate([Ts[:1], Ts[1:] @ se3.exp_all(steps.reshape(-1, 6))])

    def errors(steps):
        found, out = moved(steps), []
        for edge in edges:
            error = se3.log(se3.inverse(edge.T_a_b) @ se3.inverse(found[edge.a]) @ found[edge.b])
            out += [error[:3] / edge.sigma_distance, error[3:] / edge.sigma_angle]
        return np.concatenate(out)

    best = least_squares(errors, np.zeros(24), xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose(optimize(Ts, edges), moved(best.x), atol=2e-3)
