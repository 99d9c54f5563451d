"""Systematic errors of the registration: no term of it may pull from the true pose."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dudmap import Config
from dudmap.core.geometry.camera import Camera
from dudmap.lab import synthetic
from registration_errors import measure_pulls

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)


@pytest.fixture(scope="module")
def room():
    sequence: Any = synthetic.sequence("room", movers=(), frames=30, noise="none", seed=5, camera=CAMERA)
    return sequence


@pytest.fixture(scope="module")
def exact_pulls(room):
    return measure_pulls(room, Config(), stride=3)


def test_no_term_pulls_in_an_exact_world(exact_pulls):
    for term, pull in exact_pulls.items():
        # the size of an image pixel there is 1 cm, twice that of the full images for which the docs state the figures
        assert np.abs(pull.mean(axis=0)[:3]).max() < 1.0, term
        assert np.abs(pull.mean(axis=0)[3:]).max() < 0.03, term


class Displaced:
    """The recording with colours of a camera whose principal point is ``shift`` pixels off."""

    def __init__(self, sequence, shift):
        self._sequence, self._shift = sequence, shift

    def __getattr__(self, name) -> Any:
        return getattr(self._sequence, name)

    def __len__(self):
        return len(self._sequence)

    def __getitem__(self, index):
        frame = self._sequence[index]
        shift = self._shift if index % 2 else -self._shift
        return replace(frame, color=np.ascontiguousarray(np.roll(frame.color, shift, axis=1)))


def test_colours_that_alternate_sideways_spread_the_poses_that_colour_wants(room, exact_pulls):
    """A shift of every other image by 2 f / z pixels is a sideways motion; distances must not notice it."""
    displaced: Any = Displaced(room, 2)
    shifted = measure_pulls(displaced, Config(), stride=3)

    def sideways(pull):
        """Shift of the image that the correction causes at 2 m, pixels: both motions move it alike."""
        spread = pull.std(axis=0)
        return CAMERA.fx * (spread[0] / 1000 / 2 + np.radians(spread[4]))

    assert sideways(shifted["colour"]) > 1.0 > 2 * sideways(exact_pulls["colour"])
    assert np.allclose(shifted["distances"], exact_pulls["distances"], atol=1e-6)
