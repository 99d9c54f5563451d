"""The parts of the system that have kernels, run once on a small synthetic recording to compile them."""

from collections.abc import Callable
from dataclasses import replace


def steps() -> list[tuple[str, Callable[[], object]]]:
    """Name and action of every part with kernels, in the order in which they must run."""
    import tempfile
    from pathlib import Path

    import numpy as np

    from dudmap.config import Config
    from dudmap.core.calibration.adjustment import Adjustment, Fit
    from dudmap.core.calibration.keyframes import keyframe
    from dudmap.core.calibration.pairs import Pair, PairSet
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.map.volume import TsdfVolume
    from dudmap.core.slam import Slam
    from dudmap.lab.synthetic import sequence
    from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

    camera = DEFAULT_CAMERA.resized(160, 120)
    recording = sequence(frames=4, camera=camera, start_dynamic=True)
    poses = recording.ground_truth.Ts_world_camera
    frames = []
    small = ["volume.voxel_size=0.04", "preprocess.depth_max=4", "similarity.max_translation=0"]
    slam = Slam(camera, Config().override(small))

    def render() -> None:
        frames.extend(recording[index] for index in range(len(recording)))

    def process(system: Slam) -> None:
        for frame in frames:
            system.process(frame)

    def process_variants() -> None:
        for variant in ("preset=thesis", "dynamics.method=threshold", "tracker.robust=tukey"):
            process(Slam(camera, Config().override([variant, *small])))

    def several_voxel_sizes() -> None:
        adaptive = Slam(camera, Config().override(["volume.adaptive=true", "volume.adaptive_bend=0.05", *small]))
        for frame, T_world_camera in zip(frames, poses, strict=True):
            adaptive.volume.integrate(frame, T_world_camera)
        adaptive.volume.extract_mesh()
        adaptive.volume.raycast(poses[-1], camera)

    def color_camera() -> None:
        registered = Calibration.registered(camera)
        system = Slam(camera, Config().override(small), calibration=replace(registered, delay=0.01))
        process(system)
        static, still = np.zeros(camera.shape, bool), np.zeros(6)
        first, second = (keyframe(slam.preprocess(frames[n]), registered, poses[n], still, static) for n in (0, -1))
        pairs, adjustment = PairSet([Pair(first, second)], 1), Adjustment(registered, Config().sensor)
        adjustment.with_poses(pairs, Fit.tracked(pairs, registered), adjustment.levels)

    def save_and_load() -> None:
        with tempfile.TemporaryDirectory() as folder:
            slam.volume.save(Path(folder) / "map.npz")
            TsdfVolume.load(Path(folder) / "map.npz")

    return [
        ("synthetic frames", render),
        ("tracking, labels and map", lambda: process(slam)),
        ("variants of the method", process_variants),
        ("colour camera", color_camera),
        ("mesh", lambda: slam.volume.extract_mesh()),
        ("view", lambda: slam.volume.raycast(slam.trajectory.Ts_world_camera[-1], camera)),
        ("several voxel sizes", several_voxel_sizes),
        ("map file", save_and_load),
    ]
