"""Posed images with masks for nerfstudio and COLMAP."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import write_image, write_text
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.lens import Lens, OtherView
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import ConfigError, DatasetError, NoImagesError
from dudmap.input_files import damaged
from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.sequences.images import read_mask
from dudmap.io.sequences.intrinsics import DISTORTION_KEYS
from dudmap.io.sequences.pose_matrices import OPENGL_AXES

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence

PIXEL = 0.5
"""Pixel convention of these programs: the corner of the first pixel is 0."""


class View(NamedTuple):
    """A posed image.

    Attributes:
        color: (h, w, 3) uint8, as recorded.
        moving: (h, w) bool, dynamic pixels.
        T_world_color: (4, 4) pose of the colour image.
    """

    name: str
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    moving: NDArray[np.bool_]
    T_world_color: NDArray[np.float64]


def write_nerfstudio(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write ``transforms.json``, images/, depth/ (16 bit, millimetres), masks/ (0 = dynamic) and points.ply (seed
    points); poses are camera to world with OpenGL axes."""
    sequence = images_of(run, options)
    _seeds(run, options).save(path.parent / "points.ply")
    folders = _folders(path.parent, "images", "depth", "masks")
    frames = []
    for view in _views(run, sequence, options.every):
        name = f"{view.name}.png"
        millimetres = np.rint(1000 * view.depth)
        depth = np.where(millimetres > 65535, 0, millimetres).astype(np.uint16)
        for folder, image in zip(folders, (view.color, depth, ~view.moving), strict=True):
            write_image(folder / name, image, sync=False)
        frames.append(
            {
                "file_path": f"images/{name}", "depth_file_path": f"depth/{name}", "mask_path": f"masks/{name}",
                "transform_matrix": (view.T_world_color @ OPENGL_AXES).tolist(),
            }
        )  # fmt: skip
    camera = run.color_camera(sequence)
    lens = dict(zip(DISTORTION_KEYS, (*camera.distortion, *(0.0,) * 5), strict=False))
    tree = {
        "camera_model": "OPENCV", "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + PIXEL,
        "cy": camera.cy + PIXEL, "w": camera.width, "h": camera.height, **lens, "depth_unit_scale_factor": 0.001,
        "ply_file_path": "points.ply", "frames": frames,
    }  # fmt: skip
    write_text(path, json.dumps(tree, indent=2) + "\n")


def write_colmap(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write ``cameras.txt``, ``images.txt``, ``points3D.txt`` (without tracks), images/ and masks/ (``NAME.png.png``, 0
    = dynamic, for ``ImageReader.mask_path``)."""
    sequence, seeds = images_of(run, options), _seeds(run, options)
    images, masks = _folders(path.parent, "images", "masks")
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its 2D points"]
    for number, view in enumerate(_views(run, sequence, options.every), start=1):
        name = f"{view.name}.png"
        write_image(images / name, view.color, sync=False)
        write_image(masks / f"{name}.png", ~view.moving, sync=False)
        T = se3.inverse(view.T_world_color)
        x, y, z, w = se3.rotation_to_quat_xyzw(T[:3, :3])
        numbers = " ".join(f"{value:.9f}" for value in (w, x, y, z, *T[:3, 3]))
        lines += [f"{number} {numbers} 1 {name}", ""]
    write_text(path.parent / "images.txt", "\n".join(lines) + "\n")
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    for number, (xyz, rgb) in enumerate(zip(seeds.vertices.tolist(), seeds.colors.tolist(), strict=True), start=1):
        lines.append(f"{number} {xyz[0]:.5f} {xyz[1]:.5f} {xyz[2]:.5f} {rgb[0]} {rgb[1]} {rgb[2]} 0")
    write_text(path.parent / "points3D.txt", "\n".join(lines) + "\n")
    camera = _colmap_camera(run.color_camera(sequence))
    write_text(path, f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n1 {camera}\n")


def _folders(parent: Path, *names: str) -> list[Path]:
    for name in names:
        (parent / name).mkdir(exist_ok=True)
    return [parent / name for name in names]


def _colmap_camera(camera: Camera) -> str:
    numbers = [camera.fx, camera.fy, camera.cx + PIXEL, camera.cy + PIXEL, *camera.distortion]
    model = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV"}[len(camera.distortion)]
    numbers += [0.0] * 3 if model == "FULL_OPENCV" else []
    return f"{model} {camera.width} {camera.height} " + " ".join(f"{number:.9g}" for number in numbers)


def images_of(run: RunContent, options: ExportOptions) -> "Sequence":
    """The recording of a run: given, kept in the run folder, or named by the run.

    Raises:
        NoImagesError: There are no images, or no masks.
        DatasetError: The given recording cannot be read.
    """
    given = {"path": options.sequence, "camera": options.camera}
    kept = run.folder / "images"
    known = {"path": kept} if (kept / "associations.txt").is_file() else run.recording
    opened = known | {name: value for name, value in given.items() if value is not None}
    keep = "name the recording by --sequence, or repeat the run with --save-images"
    if "path" not in opened:
        raise NoImagesError(f"{run.folder} holds no images and names no recording; {keep}")
    if options.every < 1:
        raise ConfigError(f"found --every {options.every}; expected 1 or more")
    run.mask_files()
    from dudmap.io.sequences import open_sequence

    try:
        with damaged(DatasetError, f"{run.folder}/metrics.json"):
            sequence = open_sequence(**opened)
    except DatasetError as error:
        if options.sequence is not None:
            raise
        raise NoImagesError(
            f"{run.folder} holds no images, and its recording cannot be read ({error}); {keep}"
        ) from error
    run.color_camera(sequence)  # errors occur before anything is written
    return sequence


def _seeds(run: RunContent, options: ExportOptions) -> Mesh:
    return replace(edited(run.surface, options), faces=np.empty((0, 3), np.int32))


def _views(run: RunContent, sequence: "Sequence", every: int) -> Iterator[View]:
    other = None
    if sequence.calibration is not None:
        other = OtherView(Lens(sequence.camera), Lens(run.color_camera(sequence)))
    for index, T_world_camera, mask in run.frames_of(sequence):
        if index % every:
            continue
        frame, moving = sequence[index], read_mask(mask)
        if moving.shape != frame.depth.shape:
            raise DatasetError(f"the masks of {run.folder} do not have the size of the images of {sequence.name}")
        taken = frame.timestamp if frame.color_timestamp is None else frame.color_timestamp
        depth, T_world_color = frame.depth, run.color_pose(taken)
        if other is not None:
            T_color_depth = se3.inverse(T_world_color) @ T_world_camera
            depth, moving = other.depth(depth, T_color_depth), other.mask(moving, depth, T_color_depth)
        yield View(f"frame_{index:05d}", frame.rgb, depth, moving, T_world_color)
