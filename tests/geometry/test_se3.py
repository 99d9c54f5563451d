"""Identities that rigid motions satisfy, for random motions."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dudmap.core.geometry import se3

number = st.floats(-1.0, 1.0)
twists = st.builds(lambda v, omega: np.array([*v, *omega]), st.tuples(*[number] * 3), st.tuples(*[number] * 3))
turns = st.builds(
    lambda axis, angle: np.array(axis) / np.linalg.norm(axis) * angle,
    st.tuples(*[st.floats(0.1, 1.0)] * 3),
    st.floats(0.0, np.pi - 1e-6),
)
QUICK = settings(max_examples=60, deadline=None)


@QUICK
@given(twists)
def test_exp_is_the_matrix_exponential(xi):
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = se3.hat(xi[3:]), xi[:3]
    assert np.allclose(se3.exp(xi), expm(generator), atol=1e-9)


@QUICK
@given(st.lists(twists, max_size=4), st.floats(0, 1e-4))
def test_motions_of_many_twists_are_those_of_each(xis, size):
    xis = np.array([*xis, np.zeros(6), *(size * xi for xi in xis)])
    Ts = se3.exp_all(xis)
    assert np.allclose(Ts, [se3.exp(xi) for xi in xis], rtol=0, atol=1e-14)
    assert np.allclose(se3.log_all(Ts), [se3.log(T) for T in Ts], rtol=0, atol=1e-9)
    assert np.array_equal(se3.adjoint(Ts), [se3.adjoint(T) for T in Ts])
    assert np.array_equal(se3.small_adjoint(xis), [se3.small_adjoint(xi) for xi in xis])


@QUICK
@given(twists)
def test_log_undoes_exp(xi):
    assert np.allclose(se3.log(se3.exp(xi)), xi, atol=1e-7)


@QUICK
@given(twists, st.floats(1e-12, 1e-3))
def test_small_motions_lose_nothing(xi, size):
    assert np.allclose(se3.log(se3.exp(xi * size)), xi * size, rtol=1e-5, atol=1e-15)


@QUICK
@given(turns)
def test_rotation_vectors_up_to_half_a_turn(omega):
    R = Rotation.from_rotvec(omega).as_matrix()
    assert np.allclose(se3.log_rotation(R), omega, atol=1e-6)
    assert np.isclose(se3.rotation_angle(R), np.linalg.norm(omega), atol=1e-6)
    T = np.eye(4)
    T[:3, :3] = R
    assert np.allclose(se3.log_all(T[None])[0, 3:], omega, atol=1e-6)


@QUICK
@given(twists, twists)
def test_inverse_and_interpolation(a, b):
    T_a, T_b = se3.exp(a), se3.exp(b)
    assert np.allclose(se3.inverse(T_a) @ T_a, np.eye(4), atol=1e-12)
    assert np.allclose(se3.inverse(np.stack([T_a, T_b]))[1], se3.inverse(T_b))
    assert np.allclose(se3.interpolate(T_a, T_b, 0.0), T_a, atol=1e-9)
    assert np.allclose(se3.interpolate(T_a, T_b, 1.0), T_b, atol=1e-7)
    half = se3.interpolate(T_a, T_b, 0.5)
    assert np.allclose(se3.inverse(T_a) @ half, se3.inverse(half) @ T_b, atol=1e-7)


@QUICK
@given(turns)
def test_quaternions_agree_with_scipy(omega):
    rotation = Rotation.from_rotvec(omega)
    quat_xyzw = se3.rotation_to_quat_xyzw(rotation.as_matrix())
    assert quat_xyzw[3] >= 0
    expected = rotation.as_quat(canonical=True)
    assert np.allclose(quat_xyzw, expected, atol=1e-7) or np.allclose(quat_xyzw, -expected, atol=1e-7)
    assert np.allclose(se3.quat_xyzw_to_rotation(3 * quat_xyzw), rotation.as_matrix(), atol=1e-9)


def test_nearest_rotation_is_orthonormal():
    R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    mended = se3.nearest_rotation(R + 1e-3 * np.arange(9).reshape(3, 3))
    assert np.allclose(mended.T @ mended, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(mended), 1.0)
    assert np.allclose(se3.nearest_rotation(R), R)


@given(twists)
def test_exp_rotation_is_the_rotation_of_exp(xi):
    turn = np.concatenate([np.zeros(3), xi[3:]])
    assert np.allclose(se3.exp_rotation(xi[3:]), se3.exp(turn)[:3, :3], atol=1e-12)


def test_adjoints():
    rng = np.random.default_rng(1)
    T = se3.exp(np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(-1.5, 1.5, 3)]))
    xi = rng.normal(size=6)
    np.testing.assert_allclose(T @ se3.exp(xi) @ se3.inverse(T), se3.exp(se3.adjoint(T) @ xi), atol=1e-12)
    np.testing.assert_allclose(expm(se3.small_adjoint(xi)), se3.adjoint(se3.exp(xi)), atol=1e-12)


def test_interpolation_in_time_and_beyond_its_ends():
    Ts = np.tile(np.eye(4), (2, 1, 1))
    Ts[1, 0, 3] = 0.2
    for time, x in ((0.0, 0.0), (1.0, 0.0), (1.5, 0.05), (3.0, 0.2), (9.0, 0.2)):
        T = se3.interpolate_in_time(np.array([1.0, 3.0]), Ts, time)
        np.testing.assert_allclose(T[:3, 3], [x, 0, 0], atol=1e-12)


def test_angles_of_many_rotations_are_those_of_each():
    rng = np.random.default_rng(5)
    twists = np.concatenate([rng.normal(0, 1, (20, 6)), rng.normal(0, 1e-9, (3, 6)), np.zeros((1, 6))])
    Ts = se3.exp_all(twists)
    np.testing.assert_allclose(se3.rotation_angles(Ts), [se3.rotation_angle(T) for T in Ts], rtol=1e-9, atol=1e-12)
