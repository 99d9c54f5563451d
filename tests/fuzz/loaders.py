"""Everything that reads files from elsewhere, each with a writer of a small valid input.

A new loader is one line in ``LOADERS``.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

import layouts
from dudmap.errors import DudmapError, FrameError
from dudmap.sequences import open_sequence

CAMERA = "60,60,31.5,23.5,64,48"


@dataclass(frozen=True)
class Loader:
    """``write(folder)`` makes a valid input and returns its path; ``load(path)`` reads everything in it."""

    write: Callable
    load: Callable
    slow: bool = False


def read_recording(path, camera=None):
    """Open a recording and read all that a run reads; one damaged frame does not end a run."""
    sequence = open_sequence(path, camera)
    assert len(sequence) <= 100_000
    for index in range(min(len(sequence), 4)):
        try:
            frame = sequence[index]
            assert frame.depth.shape == sequence.camera.shape
            assert frame.depth.dtype == np.float32
            assert np.isfinite(frame.depth).all()
            sequence.mask(index)
        except FrameError as error:
            check_sentence(error)
    if sequence.ground_truth is not None:
        assert np.isfinite(sequence.ground_truth.Ts_world_camera).all()


def check_sentence(error):
    """One line of text that a person can read."""
    text = str(error)
    assert text
    assert len(text) < 4000
    assert text.isprintable(), f"not printable: {text!r}"


def layout(write):
    return Loader(lambda folder: small(write, folder), read_recording, slow=write in LARGE)


LARGE = (
    layouts.bonn, layouts.icl_nuim, layouts.icl_nuim_loop, layouts.corbs, layouts.seven_scenes, layouts.redwood_object,
    layouts.epfl,
)  # fmt: skip
"""Layouts whose images have a fixed size of 640x480: about ten times as slow."""


def small(write, folder):
    """The first of the three frames would do; the folder of a layout as it is."""
    return layouts.write(write, folder)[0]


def tum_with_masks(folder):
    path = small(layouts.tum, folder)
    lines = ""
    for k in range(3):
        stamp = f"{100 + 0.1 * k:.6f}"
        layouts.write_color(path / f"mask/{stamp}.png", k)
        lines += f"{stamp} mask/{stamp}.png\n"
    (path / "mask.txt").write_text(lines)
    return path


def masks(folder):
    from recordings import color_image

    for k in range(2):
        layouts.cv2.imwrite(str(folder / f"{100 + 0.1 * k:.6f}.png"), color_image(k)[..., 0])
    return folder


def load_masks(path):
    from dudmap.geometry.camera import Camera
    from dudmap.sequences.masks import MaskFolder

    folder = MaskFolder(path, np.array([100.0, 100.1, 100.2]), Camera(60, 60, 31.5, 23.5, 64, 48))
    for index in range(3):
        folder[index]


def klg(folder):
    from sequences.test_klg import write_klg

    return write_klg(folder / "a.klg", 2)


def sens(folder):
    from sequences.test_sens import write_sens

    return write_sens(folder / "a.sens", 2)


def r3d(folder):
    from sequences.test_record3d import write_r3d

    return write_r3d(folder / "a.r3d", 2)


def bag(kind, name, folder, **options):
    from bags import write_bag

    path = write_bag(folder / name, kind, 2, **options)
    return path


def realsense_file(folder):
    from sequences.test_realsense_recording import write_realsense

    return write_realsense(folder / "a", "sqlite") / "a.db3"


def archive(kind, folder):
    import shutil

    source = small(layouts.tum, folder / "source")
    made = shutil.make_archive(str(folder / "packed"), kind, source.parent, source.name)
    shutil.rmtree(folder / "source")
    return Path(made)


def volume():
    """A small map of a wall."""
    from dudmap.config import SensorConfig, VolumeConfig
    from dudmap.frames.frame import Frame
    from dudmap.geometry.camera import Camera
    from dudmap.mapping.volume import TsdfVolume

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
    from dudmap.frames.frame import Frame
    from dudmap.geometry.camera import Camera
    from dudmap.mapping.adaptive_volume import AdaptiveVolume

    config = VolumeConfig(voxel_size=0.1, adaptive=True, adaptive_bend=0.1)
    made = AdaptiveVolume(Camera(20, 20, 15.5, 11.5, 32, 24), config, SensorConfig(), 3.0)
    depth = np.broadcast_to(1.0 / (1 - 0.7 * np.abs(np.arange(32) - 15.5) / 20), (24, 32)).astype(np.float32)
    for _ in range(3):
        made.integrate(Frame(0.0, depth, np.full((24, 32, 3), 90, np.uint8)), np.eye(4))
    assert made.levels[0].blocks.num_voxel_blocks > 0
    made.save(folder / "map.npz")
    return folder / "map.npz"


def load_map(path):
    from dudmap.mapping.volume import TsdfVolume

    loaded = TsdfVolume.load(path)
    loaded.extract_mesh()
    loaded.raycast(np.eye(4), loaded.camera)


def state(folder):
    from dudmap.state.database import StateDatabase
    from dudmap.state.system import take_snapshot

    database = StateDatabase(folder / "state.db")
    database.write(take_snapshot({"volume": volume(), "numbers": np.arange(100.0)}, database), {"next": 1})
    database.close()
    return folder / "state.db"


def load_state(path):
    from dudmap.state.database import StateReader
    from dudmap.state.system import restore

    try:
        reader = StateReader(path)
        reader.meta()
        restore(reader, {"volume": volume()})
        reader.close()
    finally:
        for companion in ("-wal", "-shm"):  # SQLite makes them beside any database that is read while it may be written
            path.with_name(path.name + companion).unlink(missing_ok=True)


def keyframes(folder):
    from dudmap.places.place_recognition import Keyframe, PlacedFeatures
    from dudmap.places.saved_map import SavedMap

    rng = np.random.default_rng(0)
    features = PlacedFeatures(rng.random((5, 128), np.float32), rng.random((5, 3)))
    saved = SavedMap(volume(), [Keyframe(float(k), np.eye(4), features) for k in range(2)])
    saved.save_keyframes(folder / "keyframes.npz")
    return folder / "keyframes.npz"


def load_keyframe_file(path):
    from dudmap.places.saved_map import load_keyframes

    load_keyframes(path)


def depth_model(folder):
    from dudmap.calibration.depth_model import TERMS, DepthModel

    n = len(TERMS)
    DepthModel(np.zeros(n), np.eye(n), np.ones(2), 3).save(folder / "depth_model.npz")
    return folder / "depth_model.npz"


def load_depth_model(path):
    from dudmap.calibration.depth_model import DepthModel

    DepthModel.load(path).correction  # noqa: B018


def text(name, content, folder):
    (folder / name).write_text(content() if callable(content) else content)
    return folder / name


def configuration():
    from dudmap.config import Config

    return Config().to_toml()


def load_config(path):
    from dudmap.config import Config

    Config.load(path)


def calibration():
    import tomli_w

    from dudmap.geometry.calibration import Calibration
    from dudmap.geometry.camera import Camera

    return tomli_w.dumps(Calibration(Camera(60, 60, 31.5, 23.5, 64, 48, distortion=(0.1, 0, 0, 0, 0))).tree())


def load_calibration(path):
    from dudmap.geometry.calibration import Calibration

    Calibration.load(path)


def trajectory():
    return "# t x y z qx qy qz qw\n" + "".join(layouts.tum_line(k, layouts.pose(k)) for k in range(5))


def load_trajectory(path):
    from dudmap.geometry.trajectory import Trajectory

    loaded = Trajectory.load(path)
    assert np.isfinite(loaded.Ts_world_camera).all()


def camera_files(folder):
    (folder / "camera.json").write_text(layouts.open3d_camera())
    return folder / "camera.json"


def load_camera_file(path):
    from dudmap.sequences import camera_json

    camera_json.load([path], 1000.0).camera(64, 48)


def load_intrinsics(path):
    from dudmap.sequences import intrinsics

    found = intrinsics.from_file(path)
    found.camera(64, 48)
    found.calibration()


INTRINSICS = (
    "fx 60\nfy 61\ncx 31\ncy 23\nwidth 64\nheight 48\nk1 0.1\ncolor_fx 60\ncolor_fy 60\ncolor_cx 31\ncolor_cy 23\n"
    "color_width 64\ncolor_height 48\nT_depth_color 1 0 0 0.02 0 1 0 0 0 0 1 0\n"
)


IMAGES = "depth", "color", "tiff", "webp", "pnm", "bmp"


def image(kind, folder):
    extension = {"depth": ".png", "color": ".jpg", "tiff": ".tiff", "webp": ".webp", "pnm": ".pgm", "bmp": ".bmp"}[kind]
    path = folder / f"image{extension}"
    (layouts.write_depth if kind in ("depth", "tiff", "pnm") else layouts.write_color)(path, 0, width=32, height=16)
    return path


def load_image(path):
    from dudmap.sequences import images

    for read in (images.read_color, partial(images.read_depth, depth_scale=1000.0), images.read_mask):
        try:
            read(path)
        except FrameError as error:
            check_sentence(error)


def array(folder):
    np.save(folder / "depth.npy", np.ones((16, 20), np.float32))
    return folder / "depth.npy"


def load_array(path):
    from dudmap.sequences import images

    images.read_depth_array(path)


def mesh(extension, folder):
    from dudmap.geometry.mesh import Mesh

    corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 2]], np.float32)
    made = Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]], np.int32), np.full((4, 3), 90, np.uint8), corners)
    made.save(folder / f"mesh.{extension}")
    return folder / f"mesh.{extension}"


def load_mesh(path):
    from dudmap.geometry.mesh import Mesh

    Mesh.load(path).area()


def run_folder(folder):
    """A run folder with all that viewers and exporters read, and no map."""
    (folder / "run" / "masks").mkdir(parents=True)
    run = folder / "run"
    (run / "trajectory.txt").write_text(trajectory())
    (run / "calibration.toml").write_text(calibration())
    (run / "config.toml").write_text("preset = 'default'\n")
    metrics = {
        "sequence": "a", "tracked": 5, "frames": 5, "mesh_triangles": 2, "versions": {"dudmap": "0.1.0"},
        "lost_frames": [{"timestamp": 1.0, "reason": "fast"}],
        "camera": {"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "depth_scale": 1000.0},
    }  # fmt: skip
    (run / "metrics.json").write_text(json.dumps(metrics))
    (run / "timings.csv").write_text(
        "timestamp,state,fused,dynamic_share,reading,total,track\n0.000000,tracked,1,0.1,1,20,9\n"
    )
    row = {"timestamp": 0.0, "movers": [{"id": 1, "box": [[0, 0, 0], [1, 1, 1]], "speed": 0.5}]}
    (run / "movers.jsonl").write_text(json.dumps(row) + "\n")
    mesh("ply", run)
    np.savez(run / "residuals.npz", edges=np.arange(5.0), counts=np.arange(4), prior=[0.5, 0.5], sigma=[1.0, 9.0])
    layouts.write_color(run / "masks/0.000000.png", 0)
    (run / "thumbnails").mkdir()
    layouts.write_color(run / "thumbnails/0.000000.color.jpg", 0)
    return run


def load_run_folder(path):
    from dudmap.evaluation.files import tracked_share
    from dudmap.exporting.run_content import RunContent
    from dudmap.viewing.run_files import RunFiles
    from dudmap.viewing.stored_view import frames_of

    def content():
        run = RunContent.load(path)
        return run.trajectory, run.mesh, run.movers, run.calibration, run.mask_files(), run.color_pose(0.5)

    def viewed():
        run = RunFiles.load(path)
        return frames_of(run), run.stages, [run.column(stage) for stage in run.stages]

    for read in (viewed, content, lambda: tracked_share(3, path, None)):
        try:
            read()
        except DudmapError as error:
            check_sentence(error)


LOADERS = {
    **{f"layout {write.__name__}": layout(write) for write in layouts.LAYOUTS},
    "layout tum with masks": Loader(tum_with_masks, read_recording),
    "klg": Loader(klg, partial(read_recording, camera=CAMERA)),
    "sens": Loader(sens, read_recording),
    "record3d": Loader(r3d, read_recording),
    "bag of ROS 1": Loader(partial(bag, "ros1", "a.bag"), read_recording, slow=True),
    "bag in SQLite": Loader(partial(bag, "sqlite", "a"), read_recording, slow=True),
    "bag in MCAP": Loader(partial(bag, "mcap", "a"), read_recording, slow=True),
    "RealSense file": Loader(realsense_file, read_recording, slow=True),
    "archive zip": Loader(partial(archive, "zip"), read_recording),
    "archive tar": Loader(partial(archive, "tar"), read_recording),
    "archive tar.gz": Loader(partial(archive, "gztar"), read_recording),
    "archive tar.xz": Loader(partial(archive, "xztar"), read_recording),
    "masks": Loader(masks, load_masks),
    "map": Loader(map_file, load_map),
    "adaptive map": Loader(adaptive_map_file, load_map),
    "state of a run": Loader(state, load_state),
    "keyframes": Loader(keyframes, load_keyframe_file),
    "depth model": Loader(depth_model, load_depth_model),
    "configuration": Loader(partial(text, "config.toml", configuration), load_config),
    "calibration": Loader(partial(text, "calibration.toml", calibration), load_calibration),
    "trajectory": Loader(partial(text, "trajectory.txt", trajectory), load_trajectory),
    "intrinsics": Loader(partial(text, "intrinsics.txt", INTRINSICS), load_intrinsics),
    "camera as JSON": Loader(camera_files, load_camera_file),
    **{f"image {kind}": Loader(partial(image, kind), load_image) for kind in IMAGES},
    "array": Loader(array, load_array),
    **{f"mesh {kind}": Loader(partial(mesh, kind), load_mesh) for kind in ("ply", "obj", "glb", "stl")},
    "run folder": Loader(run_folder, load_run_folder),
}  # fmt: skip
"""All loaders by name."""
