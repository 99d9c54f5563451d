"""Maps, the stored state of a run and keyframes, each with a writer of a small valid one."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def volume():
    """A small map of a wall."""
    from dudmap.config import SensorConfig, VolumeConfig
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.map.volume import TsdfVolume

    made = TsdfVolume(Camera(20, 20, 15.5, 11.5, 32, 24), VolumeConfig(voxel_size=0.1), SensorConfig(), 3.0)
    frame = Frame(0.0, np.full((24, 32), 1.5, np.float32), np.full((24, 32, 3), 90, np.uint8))
    made.integrate(frame, np.eye(4), np.ones((24, 32), bool))
    return made


def map_file(folder):
    volume().save(folder / "map.npz")
    return folder / "map.npz"


def adaptive_map_file(folder):
    """A small map of two walls that meet, with smaller voxels at their edge."""
    from dudmap.config import SensorConfig, VolumeConfig
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.map.adaptive_volume import AdaptiveVolume

    config = VolumeConfig(voxel_size=0.1, adaptive=True, adaptive_bend=0.1)
    made = AdaptiveVolume(Camera(20, 20, 15.5, 11.5, 32, 24), config, SensorConfig(), 3.0)
    depth = np.broadcast_to(1.0 / (1 - 0.7 * np.abs(np.arange(32) - 15.5) / 20), (24, 32)).astype(np.float32)
    for _ in range(3):
        made.integrate(Frame(0.0, depth, np.full((24, 32, 3), 90, np.uint8)), np.eye(4))
    assert made.levels[0].blocks.num_voxel_blocks > 0
    made.save(folder / "map.npz")
    return folder / "map.npz"


def load_map(path):
    from dudmap.core.map.volume import TsdfVolume

    loaded = TsdfVolume.load(path)
    loaded.extract_mesh()
    loaded.raycast(np.eye(4), loaded.camera)


def parts():
    """A state with values of all kinds that a tree has, and their annotations by name."""
    from collections import deque

    from dudmap.config import Config
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.map.volume import TsdfVolume
    from dudmap.core.places.atlas import TimedPose
    from dudmap.core.places.place_recognition import Keyframe, PlacedFeatures
    from dudmap.core.tracking.motion_model import MotionModel

    rng = np.random.default_rng(0)
    features = PlacedFeatures(rng.random((5, 128), np.float32), rng.random((5, 3)))
    keyframe = Keyframe(1.0, np.eye(4), features)

    @dataclass
    class Everything:
        numbers: NDArray[np.float64]
        again: list[Keyframe]
        keyframe: Keyframe
        generator: np.random.Generator
        config: Config
        camera: Camera
        last: deque[float | str | None]
        poses: list[TimedPose]
        seen: set[int]
        pair: tuple[int, float]

    numbers, poses = np.arange(100.0), [TimedPose(0.1 * k, np.eye(4), 0) for k in range(40)]
    everything = Everything(
        numbers, [keyframe, keyframe], keyframe, rng, Config(), Camera(20, 20, 15.5, 11.5, 32, 24),
        deque([1.5, None, "a"], 5), poses, {1, 2}, (1, np.float32(0.5)),
    )  # fmt: skip
    made = {"volume": volume(), "everything": everything, "motion": MotionModel(Config().tracker)}
    return made, {"volume": TsdfVolume, "everything": Everything, "motion": MotionModel}


def state(folder):
    from dudmap.app.state.database import StateDatabase
    from dudmap.app.state.system import take_snapshot

    database = StateDatabase(folder / "state.db")
    database.write(take_snapshot(parts()[0], database), {"next": 1})
    database.close()
    return folder / "state.db"


def load_state(path):
    from dudmap.app.state.database import StateReader
    from dudmap.app.state.tree import TreeReader

    try:
        reader = StateReader(path)
        reader.meta()
        new, hints = parts()
        tree = TreeReader(reader)
        found = {name: tree.part(name, hint, new["motion"]) for name, hint in hints.items()}
        reader.close()
        everything = found["everything"]
        assert everything.keyframe.features.points.dtype.kind in "fiu"
        assert all(type(pose.submap) is int for pose in everything.poses)
        found["volume"].extract_mesh()
    finally:
        for companion in ("-wal", "-shm"):  # SQLite makes them beside any database that is read while it may be written
            path.with_name(path.name + companion).unlink(missing_ok=True)


def keyframes(folder):
    from dudmap.core.places.place_recognition import Keyframe, PlacedFeatures
    from dudmap.core.places.saved_map import SavedMap

    rng = np.random.default_rng(0)
    features = PlacedFeatures(rng.random((5, 128), np.float32), rng.random((5, 3)))
    saved = SavedMap(volume(), [Keyframe(float(k), np.eye(4), features) for k in range(2)])
    saved.save_keyframes(folder / "keyframes.npz")
    return folder / "keyframes.npz"


def load_keyframe_file(path):
    from dudmap.core.places.saved_map import load_keyframes

    load_keyframes(path)


def merged_folder(folder):
    """Folder of two merged runs, as other commands read it."""
    from file_loaders import run_folder, trajectory

    run = run_folder(folder)
    (run / "trajectory-2.txt").write_text(trajectory())
    (run / "merge.json").write_text('{"runs": ["a", "b"], "trajectories": ["trajectory.txt", "trajectory-2.txt"]}')
    return run


def load_merged_folder(path):
    from file_loaders import load_run_folder

    from dudmap.fleet.merge import save_trajectories

    load_run_folder(path)
    with tempfile.TemporaryDirectory() as out:
        save_trajectories(Path(out), [(path, np.eye(4))])


def world(folder):
    """Folder of many merged runs."""
    import json

    made = folder / "world"
    for name in ("map", "tiles"):
        (made / name).mkdir(parents=True)
    volume().save(made / "map" / "0000000000000.npz")
    (made / "tiles" / "0.glb").write_bytes(b"glTF")
    one = {"file": "map/0000000000000.npz", "codes": [0, 1], "blocks": 1, "low_m": [-9, -9, -9], "high_m": [9, 9, 9]}
    tree = {"format": "dudmap world 1", "voxel_size": 0.1, "runs": [], "ranges": [one], "map_blocks": 1, "tiles": 1}
    (made / "world.json").write_text(json.dumps(tree))
    (made / "tileset.json").write_text("{}")
    return made


def replace_world(path):
    from dudmap.fleet.merge import _check_out

    _check_out(path)
