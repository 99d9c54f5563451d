"""Run all parts with kernels on small images, to compile them.

Processes compile with one thread, so that a second one with another order halves the time; each loads the other's
kernels.
"""

import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from dudmap.app.doctor import COMPILING
from dudmap.config import Config
from dudmap.core import kernel_cache
from dudmap.core.backends.cpu import points, rvl
from dudmap.core.backends.cpu.evidence import BINS, EDGES
from dudmap.core.backends.cpu.texturing import draw_triangles, gather_colors
from dudmap.core.backends.parameters import SensorNoise, TruncationBand
from dudmap.core.backends.threads import num_threads
from dudmap.core.calibration.adjustment import Adjustment, Fit, Pair, PairSet
from dudmap.core.calibration.depth_readout import rectified_keyframe
from dudmap.core.calibration.keyframes import keyframe
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.dynamics.dominant_motion import reproject, rigid_motion
from dudmap.core.dynamics.masks import fit_mixture, full_size
from dudmap.core.formulas.residual import residual_weights
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.objects.regions import connected_regions
from dudmap.core.slam import Slam
from dudmap.thesis.slam import ThesisSlam
from dudmap.thesis_config import ThesisConfig

log = logging.getLogger(__name__)

SMALL = ["volume.voxel_size=0.04", "preprocess.depth_max=4", "similarity.max_translation=0"]
CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
SECOND_PROCESS = "labels", "several voxel sizes"
"""Parts of a second process, about half of the time."""
DURING_RUN = "motion between images", "labels", "calibration", "mesh"
"""Parts that the second process compiles while a run begins, in the order of their use."""
BEFORE_DEMO = ("tracking, labels and map", "mesh", "view"), ("motion between images", "labels", "synthetic frames")
"""Parts of two processes before a demo, which is not calibrated; both take the same time."""


def room(count: int) -> list[Frame]:
    """Images of a wall and a moving box, without kernels."""
    shade = np.random.default_rng(0).integers(40, 220, (15, 20, 3)).repeat(8, axis=0).repeat(8, axis=1)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    frames = []
    for number in range(count):
        box = (abs(u - 60 - 6 * number) < 25) & (abs(v - 60) < 30)
        depth = np.where(box, 1.2, 2.0 + 0.004 * u + 0.2 * (v > 90)).astype(np.float32)
        color = np.where(box[..., None], 255 - np.roll(shade, 6 * number, axis=1), shade).astype(np.uint8)
        frames.append(Frame(number / 30, depth, color))
    return frames


def steps() -> list[tuple[str, Callable[[], object]]]:
    """Name and action of every part with kernels."""
    frames, start, registered = room(4), np.eye(4), Calibration.registered(CAMERA)
    config = Config().override(SMALL)

    def process(*parameters: str, calibration: Calibration | None = None) -> Slam:
        slam = Slam(CAMERA, config.override(list(parameters)), calibration=calibration)
        for frame in frames:
            slam.process(frame)
        return slam

    def variants() -> None:
        slam = process("preprocess.drop_mixed=true")
        band = TruncationBand(1.0, 1.0, 1.0, 1.0, SensorNoise(1.0, 1.0, 1.0))
        image, parameters = frames[0].depth, slam.tracker.parameters(band)
        residual_weights(image, np.stack([image, image]), image, parameters)
        thesis = ThesisSlam(CAMERA, ThesisConfig(levels=2))
        for frame in frames:
            thesis.process(frame)

    def image_motion() -> None:
        seen = np.random.default_rng(0).uniform(1, 2, (60, 3))
        rigid_motion(seen, reproject(start, seen, CAMERA), CAMERA, start)

    def labels() -> None:
        slam, detector = Slam(CAMERA, config), DynamicDetector(config.dynamics, config.sensor)
        slam.reference.look_at(start)
        for number, view in enumerate(map(slam.prepare, frames)):
            if number == 0:
                detector.start(view.timestamp, view.labelled, start)
            found = detector.detect(slam.reference, view.labelled, start, view.timestamp, view.segmentation)
            detector.update(view.timestamp, view.labelled, start, (1.0, 0.0), found)
            moving, segments, sigma = view.labelled.depth > 0, view.segmentation(), view.labelled.depth
            detector.memory.update(number, view.labelled, start, moving, segments)
            detector.memory.settled(number, view.labelled, start, segments, sigma, moving)
            connected_regions(moving, view.labelled)
            full_size(moving, view.labelled.depth, view.observation.depth)
        fit_mixture(np.ones(BINS, np.int64), EDGES)  # as at the end of a run

    def calibration() -> None:
        preprocess, static = Preprocessor(CAMERA, config.preprocess), np.zeros(CAMERA.shape, bool)
        ends = preprocess(frames[0]), preprocess(frames[-1])
        taken = (keyframe(image, registered, start, np.full(6, 0.1), static) for image in ends)
        first, second = (rectified_keyframe(one, 0.01) for one in taken)
        pairs, adjustment = PairSet([Pair(first, second)], 1), Adjustment(registered, config.sensor)
        adjustment.with_poses(pairs, Fit.tracked(pairs, registered))

    def color_camera() -> None:
        process(calibration=replace(registered, delay=0.01, depth_readout=0.01))
        calibration()

    def several_voxel_sizes() -> None:
        adaptive = Slam(CAMERA, config.override(["volume.adaptive=true", "volume.adaptive_bend=0.05"]))
        for frame in frames:
            adaptive.volume.integrate(frame, start)
        adaptive.volume.extract_mesh()
        adaptive.volume.raycast(start, CAMERA)

    def small_map() -> TsdfVolume:
        slam = Slam(CAMERA, config)
        slam.volume.integrate(frames[0], start)
        return slam.volume

    def save_and_load() -> None:
        with tempfile.TemporaryDirectory() as folder:
            small_map().save(Path(folder) / "map.npz")
            TsdfVolume.load(Path(folder) / "map.npz")
        volume = small_map()
        blocks = volume.blocks
        blocks.restore(blocks.state())
        points.sample_points(
            blocks.table, blocks.coords, blocks.slot_of, blocks.free_count, blocks.geometry, blocks.colors,
            np.zeros((1, 3)), start[:3], volume.truncation / volume.sdf_unit, float(volume.config.carve_rate),
        )  # fmt: skip
        rvl.decompressed(rvl.compressed(np.ones((2, 2), np.uint16)))  # as for the stored frames of a map

    def synthetic_frames(noise: str | None = None) -> None:
        from dudmap.lab.synthetic import sequence

        recording = sequence(frames=2, camera=CAMERA, start_dynamic=True, noise=noise)
        _ = [recording[number] for number in range(len(recording))]
        if noise:
            recording.surface(observed=True)

    def texture() -> None:
        corners, faces = np.eye(3, dtype=np.float32) + np.float32(1), np.arange(3, dtype=np.int32)[None]
        numbers, depth = np.full((8, 8), -1, np.int32), np.full((8, 8), np.inf, np.float32)
        draw_triangles(corners, faces, np.float32(0), numbers, depth)
        H, one, image = np.eye(3, dtype=np.float32)[None], np.ones(1, np.float32), np.zeros((8, 8, 3), np.uint8)
        found = np.zeros((8, 8, 3), np.uint16), np.zeros((8, 8, 3, 3), np.uint8)
        gather_colors(0, 8, numbers, H, np.ones(1, np.int32), one, depth, numbers, image, *found)

    return [
        ("tracking, labels and map", process),
        ("colour camera", color_camera),
        ("mesh", lambda: small_map().extract_mesh()),
        ("view", lambda: small_map().raycast(start, CAMERA)),
        ("map file", save_and_load),
        ("variants of the method", variants),
        ("synthetic frames", synthetic_frames),
        ("motion between images", image_motion),
        ("labels", labels),
        ("calibration", calibration),
        ("several voxel sizes", several_voxel_sizes),
        ("synthetic time of flight", lambda: synthetic_frames("l515")),
        ("texture", texture),
    ]


@contextmanager
def compiled_in_background(*processes: tuple[str, ...]) -> Iterator[Callable[[], object]]:
    """Compile in other processes during the block, given a second core and a cache folder.

    The yielded function waits for them.
    """
    environment = os.environ | {"DUDMAP_THREADS": "1"} | kernel_cache.environment()
    useful = num_threads() > 1 and kernel_cache.folder() is not None
    commands = [[sys.executable, "-m", __name__, *parts] for parts in processes] if useful else []
    with ExitStack() as ends:
        started = [subprocess.Popen(each, env=environment, stdin=subprocess.DEVNULL) for each in commands]
        for process in started:
            ends.callback(process.wait)
            ends.callback(process.terminate)
        yield lambda: [process.wait() for process in started]


@contextmanager
def compiled_for_demo() -> Iterator[None]:
    """Compile a demo's kernels in two processes before its first run, because a compiler needs as much memory as the
    run."""
    if not kernel_cache.is_cold() or num_threads() < 2:
        yield
        return
    log.info(COMPILING)
    with compiled_in_background(*BEFORE_DEMO) as wait:
        wait()
        yield


def compiled_during_run(*, live: bool = False) -> AbstractContextManager[object]:
    """``compiled_in_background`` for a first run; a later ``live`` run first loads the calibration's kernels."""
    cold = kernel_cache.is_cold()
    if live and not cold:
        dict(steps())["colour camera"]()
    return compiled_in_background(*((DURING_RUN,) if cold else ()))


if __name__ == "__main__":
    logging.disable()  # the images are no recording of a camera
    actions = dict(steps())
    for part in sys.argv[1:]:
        actions[part]()
