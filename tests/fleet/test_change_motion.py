"""Motions of things between two visits, and their legs, on surfaces made of points."""

from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.core.geometry import se3
from dudmap.fleet.change_motion import Body, _gains, motion_between
from dudmap.fleet.change_objects import Piece, carries


def test_light_from_another_side_is_a_gain_that_depends_on_the_normals():
    rng = np.random.default_rng(4)
    normals, mine = np.repeat(np.eye(3), 200, axis=0), rng.uniform(40, 200, 600)
    true = np.repeat([0.7, 1.0, 1.3], 200)
    theirs = true * mine + rng.normal(0, 2, 600)
    theirs[::10] = rng.uniform(0, 255, 60)  # what is not of the thing
    assert np.abs(_gains(mine, theirs, normals) / true - 1).max() < 0.08  # they are damped


def test_slopes_are_those_of_the_intensities_along_the_surface():
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(0, 0.3, (800, 2)), np.zeros(800)])
    grey = 50 + 300 * points[:, 0] - 100 * points[:, 1]
    body = Body(points, np.tile([0.0, 0, 1], (800, 1)), np.tile(grey[:, None], 3), np.ones(800, bool), 0.01)
    assert np.allclose(body.slopes, [300, -100, 0], atol=3)


def brick(grey, turn=0.0, tilt=0.0, seed=7):
    """The five upper faces of a box of 30 x 20 x 15 cm with grey levels that are a function of the place."""
    rng, faces = np.random.default_rng(seed), []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1)):
        points, normals = rng.uniform(-1, 1, (600, 3)), np.zeros((600, 3))
        points[:, axis], normals[:, axis] = sign, sign
        faces.append((points, normals))
    points, normals = (np.concatenate(part) for part in zip(*faces, strict=True))
    shades = np.clip(np.repeat(grey(points)[:, None], 3, axis=1), 0, 255)
    R = se3.exp_rotation(np.array([tilt, 0.0, 0.0])) @ se3.exp_rotation(np.array([0.0, 0.0, turn]))
    placed = (points * (0.15, 0.1, 0.075)) @ R.T + rng.normal(0, 0.001, points.shape)
    return Body(placed, normals @ R.T, shades, np.ones(len(points), bool), 0.012)


def nowhere_free():
    return SimpleNamespace(sample=lambda points: SimpleNamespace(is_free=lambda _: np.zeros(len(points), bool)))


UP = np.array([0.0, 0, 1])


def test_a_turn_that_leaves_a_thing_as_it_was_is_ambiguous_and_one_that_its_colours_tell_is_not():
    there = nowhere_free()
    for grey, is_ambiguous in (
        (lambda p: 128 + 60 * np.cos(6 * p[:, 0] * p[:, 1]), True),  # the same after half a turn
        (lambda p: 128 + 60 * np.sin(3 * p[:, 0] + 2 * p[:, 1] + p[:, 2]), False),
    ):
        motion = motion_between(there, there, brick(grey), brick(grey, np.radians(160), seed=8), UP)
        assert (motion.ambiguous is not None) == is_ambiguous
        turn = np.degrees(se3.rotation_angle(motion.T_after_before))
        assert turn == pytest.approx(20 if is_ambiguous else 160, abs=0.5)
        assert np.degrees(motion.sigma[1]) < 1


def test_a_thing_that_stands_is_level_and_one_that_leans_is_not():
    there = nowhere_free()

    def grey(p):
        return 128 + 60 * np.sin(3 * p[:, 0] + 2 * p[:, 1] + p[:, 2])

    for tilt, expected in ((0.0, 0.0), (8.0, 8.0)):
        motion = motion_between(there, there, brick(grey), brick(grey, 0.5, np.radians(tilt), seed=8), UP)
        found = np.degrees(np.arccos(np.clip(UP @ motion.T_after_before[:3, :3] @ UP, -1, 1)))
        assert found == pytest.approx(expected, abs=0.3)


def test_a_slim_column_within_the_outline_of_a_thing_is_its_leg():
    rng = np.random.default_rng(8)
    seat, leg = rng.uniform((0, 0, 0.5), (0.5, 0.5, 0.6), (400, 3)), rng.uniform((0, 0, 0), (0.04, 0.04, 0.4), (100, 3))
    rows = np.arange(100)
    thing = Piece(np.arange(400), seat, 0.5)
    assert carries(Piece(rows, leg, 0.02), thing, UP)
    assert not carries(Piece(rows, leg + np.array([0.6, 0, 0]), 0.02), thing, UP)  # beside it
    assert not carries(Piece(rows, leg * (6, 6, 1), 0.1), thing, UP)  # a box below it
