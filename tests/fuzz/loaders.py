"""Everything that reads files from elsewhere, each with a writer of a small valid input.

A new loader is one line in ``LOADERS``.
"""

from functools import partial

import file_loaders as files
import map_loaders as maps
import recording_loaders as recordings
from verdict import Loader

import layouts

LOADERS = {
    **{f"layout {write.__name__}": recordings.layout(write) for write in layouts.LAYOUTS},
    "layout tum with masks": Loader(recordings.tum_with_masks, recordings.read_recording),
    "klg": Loader(recordings.klg, partial(recordings.read_recording, camera=recordings.CAMERA)),
    "sens": Loader(recordings.sens, recordings.read_recording),
    "record3d": Loader(recordings.r3d, recordings.read_recording),
    "Azure Kinect": Loader(recordings.mkv, recordings.read_recording),
    "bag of ROS 1": Loader(partial(recordings.bag, "ros1", "a.bag"), recordings.read_recording),
    "bag in SQLite": Loader(partial(recordings.bag, "sqlite", "a"), recordings.read_recording),
    "bag in MCAP": Loader(partial(recordings.bag, "mcap", "a"), recordings.read_recording),
    "RealSense file": Loader(recordings.realsense_file, recordings.read_recording),
    "archive zip": Loader(partial(recordings.archive, "zip"), recordings.read_recording),
    "archive tar": Loader(partial(recordings.archive, "tar"), recordings.read_recording),
    "archive tar.gz": Loader(partial(recordings.archive, "gztar"), recordings.read_recording),
    "archive tar.xz": Loader(partial(recordings.archive, "xztar"), recordings.read_recording),
    "masks": Loader(recordings.masks, recordings.load_masks),
    "map": Loader(maps.map_file, maps.load_map),
    "adaptive map": Loader(maps.adaptive_map_file, maps.load_map),
    "state of a run": Loader(maps.state, maps.load_state),
    "keyframes": Loader(maps.keyframes, maps.load_keyframe_file),
    "configuration": Loader(partial(files.text, "config.toml", files.configuration), files.load_config),
    "calibration": Loader(partial(files.text, "calibration.toml", files.calibration), files.load_calibration),
    "trajectory": Loader(partial(files.text, "trajectory.txt", files.trajectory), files.load_trajectory),
    "trajectory without times": Loader(partial(files.text, "poses.txt", files.matrices), files.load_trajectory),
    "intrinsics": Loader(partial(files.text, "intrinsics.txt", files.INTRINSICS), files.load_intrinsics),
    "camera of any name": Loader(partial(files.text, "calib.txt", files.ANY_CAMERA), files.load_any_camera),
    "camera as JSON": Loader(files.camera_files, files.load_camera_file),
    **{f"image {kind}": Loader(partial(files.image, kind), files.load_image) for kind in files.IMAGES},
    "array": Loader(files.array, files.load_array),
    **{f"mesh {kind}": Loader(partial(files.mesh, kind), files.load_mesh) for kind in ("ply", "obj", "glb", "stl")},
    "run folder": Loader(files.run_folder, files.load_run_folder),
    "run folder to write": Loader(files.run_folder, files.write_into_run_folder, owns=True),
    "merged folder": Loader(maps.merged_folder, maps.load_merged_folder),
    "world to replace": Loader(maps.world, maps.replace_world, owns=True),
}  # fmt: skip
"""All loaders by name."""
