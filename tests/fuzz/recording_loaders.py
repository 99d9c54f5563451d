"""Recordings of every format, archives of them, and masks, each with a writer of a small valid one."""

import re
from functools import partial
from pathlib import Path

import numpy as np
from verdict import Loader, check_sentence

import layout_images
import layouts
from dudmap.errors import FrameError
from dudmap.io.sequences import numbered_folders, open_sequence, tum

CAMERA = "60,60,31.5,23.5,64,48"


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


def layout(write):
    """Loader of a folder layout."""
    if write in LARGE:
        return Loader(partial(write_tenth, write), read_tenth)
    return Loader(partial(folder_of, write), read_recording)


def folder_of(write, folder):
    return layouts.write(write, folder)[0]


LARGE = (
    layouts.bonn, layouts.icl_nuim, layouts.icl_nuim_loop, layouts.corbs, layouts.seven_scenes, layouts.redwood_object,
    layouts.epfl,
)  # fmt: skip
"""Layouts whose images have the size that their data set's camera says, 640x480 or 512x424."""
CAMERAS = (
    numbered_folders.ICL_NUIM, numbered_folders.SEVEN_SCENES_DEPTH, numbered_folders.SEVEN_SCENES_COLOR,
    *(reader.published[1] for reader in (
        tum.BonnSequence, tum.CorbsSequence, numbered_folders.EpflSequence, numbered_folders.RedwoodSequence,
    )),
)  # fmt: skip
"""These cameras."""


def write_tenth(write, folder):
    """Folder of a layout whose images, and depths as text, keep every tenth row and column."""
    path = folder_of(write, folder)
    for file in path.rglob("*"):
        if file.suffix in (".png", ".jpg"):
            image = layouts.cv2.imread(str(file), layouts.cv2.IMREAD_UNCHANGED)
            height, width = image.shape[0] // 10, image.shape[1] // 10
            assert layouts.cv2.imwrite(str(file), image[: 10 * height : 10, : 10 * width : 10])
        elif file.suffix == ".depth":
            np.savetxt(file, np.loadtxt(file)[::10, ::10], fmt="%.6f")
    return path


def read_tenth(path):
    """``read_recording`` while the data sets' cameras are a tenth as large, as decoding takes most of the time."""
    for values in CAMERAS:
        values["width"], values["height"] = values["width"] // 10, values["height"] // 10
    try:
        read_recording(path)
    finally:
        for values in CAMERAS:
            values["width"], values["height"] = SIZES[id(values)]


SIZES = {id(values): (values["width"], values["height"]) for values in CAMERAS}


def tum_with_masks(folder):
    path = folder_of(layouts.tum, folder)
    lines = ""
    for k in range(3):
        stamp = f"{100 + 0.1 * k:.6f}"
        layout_images.write_color(path / f"mask/{stamp}.png", k)
        lines += f"{stamp} mask/{stamp}.png\n"
    (path / "mask.txt").write_text(lines)
    return path


def masks(folder):
    from recordings import color_image

    for k in range(2):
        layouts.cv2.imwrite(str(folder / f"{100 + 0.1 * k:.6f}.png"), color_image(k)[..., 0])
    return folder


def load_masks(path):
    from dudmap.core.geometry.camera import Camera
    from dudmap.io.sequences.masks import MaskFolder

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


def mkv(folder):
    from sequences.test_azure_kinect import write_mkv

    return write_mkv(folder / "a.mkv", frames=2)


def bag(kind, name, folder, **options):
    from bags import write_bag

    path = write_bag(folder / name, kind, 2, **options)
    if path.is_dir():  # without what no reader asks for, as the parser of YAML takes a tenth of a millisecond per word
        file = path / "metadata.yaml"
        file.write_text(
            re.sub(r"  (files:\n.*?\n(?=  \w)|(ros_distro|custom_data): .*?\n)", "", file.read_text(), flags=re.S)
        )
    return path


def realsense_file(folder):
    from sequences.test_realsense_recording import write_realsense

    return write_realsense(folder / "a", "sqlite") / "a.db3"


def archive(kind, folder):
    import shutil

    source = folder_of(layouts.tum, folder / "source")
    made = shutil.make_archive(str(folder / "packed"), kind, source.parent, source.name)
    shutil.rmtree(folder / "source")
    return Path(made)
