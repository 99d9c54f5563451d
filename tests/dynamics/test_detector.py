"""Labels: the mixture against EM on raw samples, the label kernels against plain Python, whole frames."""

from collections import deque

import cv2
import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.backends.cpu import labeling
from dudmap.core.backends.cpu.evidence import BINS, MAX_RESIDUAL
from dudmap.core.backends.device import make_backend
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.dynamics.masks import Mixture, fit_mixture
from dudmap.core.dynamics.segments import segment
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.slam import Slam
from dudmap.lab import synthetic
from oracle import half_normal_mixture_em

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)


@pytest.mark.parametrize(("share", "sigmas"), [(0.7, (1.0, 6.0)), (0.9, (0.8, 8.0)), (0.5, (1.2, 5.0))])
def test_mixture_recovers_what_the_samples_were_drawn_from(share, sigmas):
    rng = np.random.default_rng(0)
    n = 20_000
    static = rng.random(n) < share
    samples = np.abs(rng.normal(0, np.where(static, *sigmas)))
    samples = samples[samples < MAX_RESIDUAL]
    histogram, edges = np.histogram(samples, bins=BINS, range=(0, MAX_RESIDUAL))
    found = fit_mixture(histogram, edges, iterations=300)
    prior, sigma = half_normal_mixture_em(samples)
    assert found.prior[0] == pytest.approx(prior[0], abs=0.04)
    assert found.sigma[0] == pytest.approx(sigma[0], rel=0.08)
    assert found.sigma[1] == pytest.approx(sigma[1], rel=0.08)


def test_log_odds_are_the_ratio_of_the_densities():
    mixture = Mixture((0.7, 0.3), (1.1, 5.0))
    r = np.linspace(0, 10, 50)
    static, dynamic = mixture.density(r)
    assert np.allclose(mixture.log_odds(r), np.log(static / dynamic), atol=1e-4)
    fine = np.linspace(0, 80, 200_000)
    assert mixture.density(fine).sum() * (fine[1] - fine[0]) == pytest.approx(1.0, abs=1e-3)


def test_no_residuals_give_the_prior_mixture():
    assert fit_mixture(np.zeros(BINS, np.int64), np.linspace(0, MAX_RESIDUAL, BINS + 1)).prior[0] > 0.5


def grown(seeds, open_pixels, depth, tolerance):
    """Breadth-first regions in plain Python."""
    labels, count = np.zeros(depth.shape, int), 0
    for start in zip(*np.nonzero(seeds), strict=True):
        if labels[start]:
            continue
        count += 1
        labels[start] = count
        queue = deque([start])
        while queue:
            v, u = queue.popleft()
            for vn, un in ((v + 1, u), (v - 1, u), (v, u + 1), (v, u - 1)):
                if not (0 <= vn < depth.shape[0] and 0 <= un < depth.shape[1]) or labels[vn, un]:
                    continue
                if (open_pixels[vn, un] or seeds[vn, un]) and depth[vn, un] > 0:
                    if abs(depth[vn, un] - depth[v, u]) <= tolerance[v, u]:
                        labels[vn, un] = count
                        queue.append((vn, un))
    return labels, count


def test_regions_grow_like_a_breadth_first_search():
    rng = np.random.default_rng(1)
    for _ in range(10):
        depth = rng.choice([0.0, 1.0, 1.02, 1.5], (20, 30), p=[0.1, 0.4, 0.3, 0.2]).astype(np.float32)
        seeds = (rng.random(depth.shape) < 0.05) & (depth > 0)
        open_pixels, tolerance = rng.random(depth.shape) < 0.7, np.full(depth.shape, 0.05, np.float32)
        labels, count = labeling.grow_regions(seeds, open_pixels, depth, tolerance)
        expected, expected_count = grown(seeds, open_pixels, depth, tolerance)
        assert count == expected_count
        assert np.array_equal(labels, expected)


def test_the_mean_field_couples_neighbours_but_not_across_a_depth_edge():
    evidence = np.full((5, 6), 3.0, np.float32)
    evidence[2, 2] = -1.0
    flat = np.ones((5, 6), np.float32)
    near = np.full((5, 6), 0.05, np.float32)
    assert labeling.mean_field(evidence, flat, near, 4, 4)[2, 2] > 0.5
    apart = flat.copy()
    apart[2, 2] = 2.0
    assert labeling.mean_field(evidence, apart, near, 4, 4)[2, 2] == pytest.approx(1 / (1 + np.e), abs=1e-3)


def test_full_size_labels_follow_the_depth_edge():
    depth = np.ones((16, 16), np.float32)
    depth[:, 9:] = 3.0  # the edge lies inside a low-size pixel
    low_depth = np.where(np.arange(4) < 2, 1.0, 3.0)[None, :].repeat(4, axis=0).astype(np.float32)
    assert np.array_equal(labeling.upsample_labels(low_depth < 2, low_depth, depth, 4), depth < 2)


@pytest.fixture(scope="module")
def recording():
    sequence = synthetic.sequence("room", movers=("person",), frames=60, camera=SMALL, noise="none")
    return sequence, {index: sequence[index] for index in range(18, 60)}


def overlap(recording, *assignments: str, step: int = 1) -> float:
    sequence, frames = recording
    slam, scores = Slam(sequence.camera, Config().override(assignments)), []
    for index, frame in list(frames.items())[::step]:
        mask, truth = slam.process(frame).dynamic_mask, sequence.mask(index)
        if truth.mean() > 0.05:
            scores.append((mask & truth).sum() / (mask | truth).sum())
    return float(np.mean(scores))


def test_a_walking_person_is_labelled_as_a_whole(recording):
    assert overlap(recording) > 0.7


def test_without_detection_nothing_is_labelled(recording):
    assert overlap(recording, "dynamics.enabled=false", step=2) == 0.0


@pytest.mark.parametrize(("rows", "stands"), [(6, False), (45, True)])
def test_the_map_decides_about_what_images_show_to_move_only_where_it_has_enough_of_it(rows, stands):
    """Somebody turns before a wall; of what stands there the map has ``rows`` of 60 rows, which fit."""
    depth = np.full(SMALL.shape, 2.0, np.float32)
    person = np.zeros(SMALL.shape, np.bool_)
    person[30:90, 50:90] = True
    depth[person] = 1.0
    texture = np.random.default_rng(0).integers(0, 255, (*SMALL.shape, 1), np.uint8).repeat(3, axis=2)
    texture = cv2.GaussianBlur(texture, (0, 0), 3)
    known = ~person
    known[30 : 30 + rows] = True
    config = Config()
    volume = TsdfVolume(SMALL, config.volume, depth_max=5.0, backend=make_backend("cpu"))
    for _ in range(3):
        volume.integrate(Frame(0.0, depth, texture), np.eye(4), known)
    level = Level(SMALL, depth, texture[..., 0].astype(np.float32) / 255)
    detector = DynamicDetector(config.dynamics, config.sensor)
    detector.start(0.0, level, np.eye(4))
    segmentation = segment(level, np.full(SMALL.shape, 0.1, np.float32))
    labels = detector.detect(volume, level, np.eye(4), 0.1, lambda: segmentation, moving=person)
    inside = person.copy()
    inside[:40] = False  # beside the border of what the map has
    assert np.mean(labels.dynamic[inside]) == pytest.approx(0.0 if stands else 1.0, abs=0.05)
    assert not labels.dynamic[~person].any()
