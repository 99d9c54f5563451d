"""The relocalizer against stand-ins: order and verification of candidates, and when a new submap is wanted."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.frames.observation import Level, Observation, Pyramid
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.place_recognition import Keyframe, PlacedFeatures, PlaceMatch
from dudmap.core.places.relocalizer import Relocalizer
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate, StageTimer
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import ACCEPTED, Outcome, Verdict

CAMERA = Camera(fx=20.0, fy=20.0, cx=15.5, cy=11.5, width=32, height=24)
FAILED = Verdict((Outcome("check", reason="it failed"),))
GOOD = TrackingResult(np.eye(4), (1.0, 0.0), ACCEPTED, 0.9, 0.001, 0.1, 5)


def shifted(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


def frame(timestamp, depth=1.0):
    image = np.full(CAMERA.shape, depth, np.float32)
    return Observation(timestamp, CAMERA, image, image, image, np.zeros((*CAMERA.shape, 3), np.uint8))


def features(count):
    return PlacedFeatures(np.zeros((count, 128), np.float32), np.zeros((count, 3)))


def match(submap, x, support=20):
    return PlaceMatch(Keyframe(0.0, np.eye(4), features(0), submap), shifted(x), support)


class Places:
    """A keyframe database with fixed answers."""

    def __init__(self, candidates, num_features):
        self.candidates, self.num_features, self.masks = candidates, num_features, []

    def extract(self, observation, dynamic_mask=None):
        self.masks.append(dynamic_mask)
        return features(self.num_features)

    def recognise(self, features):
        return list(self.candidates)


def relocalizer(candidates=(), *, current=1, prior_map=None, num_features=100, history=True, overrides=()):
    atlas = SimpleNamespace(
        keyframes=Places(candidates, num_features),
        volumes={0: "map 0", 1: "map 1"},
        volume_around=lambda number, T_world_camera: f"map {number}",
        current=current,
        unit=1.0,
        history=object() if history else None,
    )
    return Relocalizer(Config().override(overrides), atlas, prior_map)


class Registration:
    """Registers at the pose it starts from, and records what it was called with."""

    def __init__(self, tracking=GOOD, labels=None, moved=0.0):
        self.tracking, self.labels, self.moved, self.calls = tracking, labels, moved, []

    def __call__(self, volume, T_init):
        self.calls.append((volume, T_init[0, 3]))
        return PoseEstimate(replace(self.tracking, T_world_camera=shifted(self.moved) @ T_init), self.labels)


def recover(subject, register, judge=lambda tracking: ACCEPTED, known_dynamic=None):
    level = Level(CAMERA, np.ones(CAMERA.shape, np.float32), np.ones(CAMERA.shape, np.float32))
    view = FrameView(
        frame(5.0),
        lambda: Pyramid([level], level),
        lambda: pytest.fail("no segments"),
        StageTimer(),
        known_dynamic,
    )
    return subject.recover(view, register, judge)


def lost_view(timestamp, depth=1.0):
    """What of a FrameView is used to decide on a new submap."""
    level = Level(CAMERA, np.full(CAMERA.shape, depth, np.float32), np.ones(CAMERA.shape, np.float32))
    return SimpleNamespace(
        observation=frame(timestamp, depth),
        timestamp=timestamp,
        labelled=level,
        pyramid=None,
        segmentation=lambda: None,
    )


def test_the_features_of_a_lost_frame_are_found_once():
    subject = relocalizer(overrides=["submaps.patience=0.0", "dynamics.start_seconds=0"])
    recover(subject, Registration())
    subject.lost(5.0)
    assert subject.start_verdict(lost_view(5.0)).accepted
    assert len(subject.atlas.keyframes.masks) == 1
    assert subject.start_verdict(lost_view(6.0)).accepted  # which nobody tried to recognise
    assert len(subject.atlas.keyframes.masks) == 2


def test_candidates_of_the_current_submap_come_first_and_the_atlas_stays():
    subject, register = relocalizer([match(0, 0.1), match(1, 0.2), match(0, 0.3), match(1, 0.4)]), Registration()
    assert recover(subject, register, judge=lambda tracking: FAILED) is None
    assert register.calls == [("map 1", 0.2), ("map 1", 0.4), ("map 0", 0.1), ("map 0", 0.3)]
    assert subject.atlas.current == 1


def test_the_first_verified_candidate_is_returned_with_its_submap():
    subject, register = relocalizer([match(1, 0.2), match(0, 0.1), match(0, 0.3)]), Registration(labels=None)
    result = recover(
        subject, register, judge=lambda tracking: ACCEPTED if tracking.T_world_camera[0, 3] < 0.15 else FAILED
    )
    assert (result.submap, result.estimate.T_world_camera[0, 3], result.estimate.labels) == (0, 0.1, None)
    assert len(register.calls) == 2
    assert subject.atlas.current == 1


@pytest.mark.parametrize(
    ("register", "passes"),
    [
        (Registration(), True),
        (Registration(replace(GOOD, verdict=FAILED)), False),
        (Registration(replace(GOOD, inlier_share=0.39)), False),
        (Registration(replace(GOOD, inlier_share=0.41)), True),
        (Registration(moved=0.05), True),
        (Registration(moved=0.07), False),
        (Registration(labels=SimpleNamespace(dynamic=np.arange(768).reshape(24, 32) < 384)), True),  # 0.45 on the map
        (Registration(labels=SimpleNamespace(dynamic=np.arange(768).reshape(24, 32) < 480)), False),
    ],
)
def test_registration_must_confirm_the_features(register, passes):
    assert (recover(relocalizer([match(1, 0.2)]), register) is not None) == passes


def test_the_dynamic_mask_reaches_the_features():
    subject, mask = relocalizer(), np.arange(CAMERA.width) < np.full((CAMERA.height, 1), 20)
    assert recover(subject, Registration(), known_dynamic=mask) is None
    assert len(subject.atlas.keyframes.masks) == 1
    assert np.array_equal(subject.atlas.keyframes.masks[0], mask)


def test_switched_off():
    subject = relocalizer([match(1, 0.2)], overrides=["relocalization.enabled=false"])
    assert recover(subject, Registration()) is None


def test_a_second_pass_verifies_against_the_map_of_the_first():
    """Keyframes of other submaps of the first pass have poses in other worlds: they are no candidates."""
    subject, register = relocalizer([match(7, 0.1), match(1, 0.2)], prior_map="prior map"), Registration()
    assert recover(subject, register).submap == 1
    assert register.calls == [("prior map", 0.2)]


def test_a_new_submap_is_wanted_after_a_while():
    subject = relocalizer(overrides=["dynamics.start_seconds=0"])
    assert not subject.start_verdict(lost_view(100.0)).accepted  # not lost
    subject.lost(1.0)
    subject.lost(1.5)  # lost since 1.0 still
    assert subject.is_lost
    assert not subject.start_verdict(lost_view(1.9)).accepted
    assert subject.start_verdict(lost_view(2.1)).accepted
    subject.found()
    assert not subject.is_lost
    assert not subject.start_verdict(lost_view(2.1)).accepted


@pytest.mark.parametrize(
    "options",
    [{"num_features": 14}, {"history": False}, {"overrides": ["submaps.enabled=false"]}],
)
def test_reasons_against_a_new_submap(options):
    subject = relocalizer(**options)
    subject.lost(0.0)
    assert not subject.start_verdict(lost_view(10.0)).accepted


def test_a_frame_without_depth_starts_no_submap():
    subject = relocalizer()
    subject.lost(0.0)
    assert not subject.start_verdict(lost_view(10.0, depth=0.0)).accepted


def motion_of(*, moving_share, share):
    """What of a DominantMotion is used."""
    moving = np.zeros(CAMERA.shape, bool)
    moving[: round(moving_share * CAMERA.height)] = True
    return SimpleNamespace(share=share, moving_after=moving)


@pytest.mark.parametrize(
    ("moving_share", "share", "wanted"),
    [(0.2, 0.9, True), (0.7, 0.8, False), (0.3, 0.5, False)],
    ids=["few people", "a near crowd", "a far wall seen between people"],
)
@pytest.mark.parametrize("crowded", [False, True])
def test_no_map_is_begun_where_two_motions_compete(monkeypatch, moving_share, share, wanted, crowded):
    motion = motion_of(moving_share=moving_share, share=share)
    monkeypatch.setattr("dudmap.core.places.relocalizer.dominant_motion", lambda *_: motion)
    subject = relocalizer()
    subject.lost(0.0, mostly_dynamic=crowded)
    assert not subject.start_verdict(lost_view(0.5)).accepted
    assert subject.start_verdict(lost_view(10.0)).accepted == wanted


@pytest.mark.parametrize("slow", [False, True])
def test_no_map_is_begun_on_people_whose_motion_shows_after_a_while_only(monkeypatch, slow):
    few, most = motion_of(moving_share=0.1, share=0.9), motion_of(moving_share=0.7, share=0.9)
    monkeypatch.setattr(
        "dudmap.core.places.relocalizer.dominant_motion",
        lambda before, after, _: most if slow and after - before > 0.2 else few,
    )
    subject = relocalizer()
    subject.lost(0.0)
    wanted = []
    for timestamp in np.arange(0.1, 3, 0.1):
        view = lost_view(timestamp)
        view.pyramid = timestamp
        wanted.append(subject.start_verdict(view).accepted)
    assert any(wanted) != slow


@pytest.mark.parametrize("crowded", [False, True])
def test_without_a_common_motion_a_map_is_begun_unless_people_were_in_view(monkeypatch, crowded):
    monkeypatch.setattr("dudmap.core.places.relocalizer.dominant_motion", lambda *_: None)
    subject = relocalizer()
    subject.lost(0.0, mostly_dynamic=crowded)
    assert subject.start_verdict(lost_view(10.0)).accepted != crowded


def test_lost_images_from_before_the_camera_was_found_are_not_compared(monkeypatch):
    """Nothing moved since this loss began: what an earlier loss showed does not count."""
    compared = []
    monkeypatch.setattr("dudmap.core.places.relocalizer.dominant_motion", lambda *pair: compared.append(pair))
    subject = relocalizer()
    subject.lost(0.0)
    assert not subject.start_verdict(lost_view(0.5)).accepted
    subject.found()
    subject.lost(1.0)
    assert subject.start_verdict(lost_view(10.0)).accepted
    assert not compared
