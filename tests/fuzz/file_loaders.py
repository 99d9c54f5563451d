"""Texts, images, arrays, meshes and run folders, each with a writer of a small valid one."""

import json
from functools import partial

import numpy as np
from verdict import check_sentence

import layout_images
from dudmap.errors import DudmapError, FrameError


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

    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.geometry.camera import Camera

    return tomli_w.dumps(Calibration(Camera(60, 60, 31.5, 23.5, 64, 48, distortion=(0.1, 0, 0, 0, 0))).tree())


def load_calibration(path):
    from dudmap.core.geometry.calibration import Calibration

    Calibration.load(path)


def trajectory():
    return "# t x y z qx qy qz qw\n" + "".join(layout_images.tum_line(k, layout_images.pose(k)) for k in range(5))


def matrices():
    return "".join(" ".join(f"{x:.6f}" for x in layout_images.pose(k)[:3].ravel()) + "\n" for k in range(5))


def load_trajectory(path):
    from dudmap.core.geometry.trajectory import Trajectory

    loaded = Trajectory.load(path, timestamps=np.arange(5.0))
    assert np.isfinite(loaded.Ts_world_camera).all()


def camera_files(folder):
    (folder / "camera.json").write_text(layout_images.open3d_camera())
    return folder / "camera.json"


def load_camera_file(path):
    from dudmap.io.sequences import camera_files

    camera_files.load([path]).camera(64, 48)


def load_intrinsics(path):
    from dudmap.io.sequences import intrinsics

    found = intrinsics.from_file(path)
    found.camera(64, 48)
    found.calibration()


def load_any_camera(path):
    from dudmap.io.sequences import camera_search

    found = camera_search.search(path.parent, (64, 48), (64, 48))
    if found is not None:
        found.camera(64, 48)


ANY_CAMERA = (
    "K:\n60 0 31\n0 61 23\n0 0 1\nresolution: 64x48\nfx_depth = 60\nP0: 60 0 31 0 0 61 23 0 0 0 1 0\nfx,fy\n60,61\n"
)


INTRINSICS = (
    "fx 60\nfy 61\ncx 31\ncy 23\nwidth 64\nheight 48\nk1 0.1\ncolor_fx 60\ncolor_fy 60\ncolor_cx 31\ncolor_cy 23\n"
    "color_width 64\ncolor_height 48\nT_depth_color 1 0 0 0.02 0 1 0 0 0 0 1 0\n"
)


IMAGES = "depth", "color", "tiff", "webp", "pnm", "bmp", "exr"


def image(kind, folder):
    if kind == "exr":
        (folder / "image.exr").write_bytes(layout_images.exr({"Z": np.ones((20, 8), np.float16)}))
        return folder / "image.exr"
    extension = {"depth": ".png", "color": ".jpg", "tiff": ".tiff", "webp": ".webp", "pnm": ".pgm", "bmp": ".bmp"}[kind]
    path = folder / f"image{extension}"
    (layout_images.write_depth if kind in ("depth", "tiff", "pnm") else layout_images.write_color)(
        path, 0, width=32, height=16
    )
    return path


def load_image(path):
    from dudmap.io.sequences import images

    for read in (images.read_color, partial(images.read_depth, depth_scale=1000.0), images.read_mask):
        try:
            read(path)
        except FrameError as error:
            check_sentence(error)


def array(folder):
    np.save(folder / "depth.npy", np.ones((16, 20), np.float32))
    return folder / "depth.npy"


def load_array(path):
    from dudmap.io.sequences import images

    images.read_depth_array(path)


def mesh(extension, folder):
    from dudmap.core.geometry.mesh import Mesh

    corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 2]], np.float32)
    made = Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]], np.int32), np.full((4, 3), 90, np.uint8), corners)
    made.save(folder / f"mesh.{extension}")
    return folder / f"mesh.{extension}"


def load_mesh(path):
    from dudmap.core.geometry.mesh import Mesh

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
    layout_images.write_color(run / "masks/0.000000.png", 0)
    (run / "thumbnails").mkdir()
    layout_images.write_color(run / "thumbnails/0.000000.color.jpg", 0)
    return run


def load_run_folder(path):
    from dudmap.app.viewing.run_files import RunFiles
    from dudmap.evaluation.files import tracked_share
    from dudmap.io.exporting.run_content import RunContent

    def content():
        run = RunContent.load(path)
        return run.trajectory, run.mesh, run.movers, run.calibration, run.mask_files(), run.color_pose(0.5)

    def viewed():
        run = RunFiles.load(path)
        return (
            run.figures(),
            run.mesh,
            run.thumbnails,
            run.config,
            run.stages,
            [run.column(stage) for stage in run.stages],
        )

    for read in (viewed, content, lambda: tracked_share(3, path, None)):
        try:
            read()
        except DudmapError as error:
            check_sentence(error)


def write_into_run_folder(path):
    """What a run does with a folder that exists, and what going on with a run does."""
    from dudmap.app.pipeline.run_folder import locked, prepare_run_folder, save_mask
    from dudmap.app.pipeline.storing import stored_options
    from dudmap.app.viewing.report import Thumbnails
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.errors import DudmapError

    try:
        with locked(path):
            stored_options(path)
    except DudmapError as error:
        check_sentence(error)
    with locked(path):
        prepare_run_folder(path, None, save_masks=True)
        Thumbnails().start(None, path, 3)
        save_mask(path / "masks" / "0.000000.png", np.zeros((4, 4), bool))
        Trajectory.from_poses([(0.0, np.eye(4))]).save(path / "trajectory.txt")
