"""Folders of masks, assigned to frames by name, number or time."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import LARGEST_GAP, associate
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.times import time_unit
from dudmap.errors import DatasetError
from dudmap.io.sequences.image_numbers import LARGEST_NUMBER, NUMBER
from dudmap.io.sequences.images import read_mask

WORDS = re.compile(r"[\W_]*(?:masks?|colou?r|rgb|depth|image|img|frame|left)[\W_]*", re.IGNORECASE)
Images = Sequence[tuple[Path, Path]]


class MaskFolder:
    """Folder of masks (PNG, 255 = dynamic).

    ``000030.png``, ``30.png``, ``rgb_000030.png`` or ``frame-000030.mask.png`` belongs to colour image 30; a time to
    the nearest frame, at most 20 ms away.

    Args:
        path: The folder.
        timestamps: (N,) increasing, seconds.
        camera: Camera of the frames and masks.

    Attributes:
        complete: Whether frames and masks match one to one.

    Raises:
        DatasetError: No folder, no mask, none for a frame, or two for one.
    """

    def __init__(self, path: str | Path, timestamps: NDArray[np.float64], camera: Camera, images: Images = ()) -> None:
        path = Path(path)
        if not path.is_dir():
            raise DatasetError(f"there is no folder {path}; expected one with masks named like the images or by time")
        there = sorted(path.glob("*.png"))
        masks = _of_one_form([mask for mask in there if re.search(r"\d", mask.stem)])
        if not masks:
            raise DatasetError(
                f"{path} holds no masks; expected PNG images named like the recording's images, or <timestamp>.png"
            )
        self._shape = camera.shape
        self._files = _by_name(masks, images)
        named = len(self._files)
        rest = sorted({*masks} - {*self._files.values()})
        self._files |= _by_time(path, rest, timestamps, self._files, images)
        self.complete = len(self._files) == len(timestamps) == len(masks)
        timed = len(self._files) - named
        how = [f"{count} by {kind}" for count, kind in ((named, "name"), (timed, "time")) if count]
        self.said = f"masks: {len(self._files)} of {len(timestamps)} frames have one ({', '.join(how)})"
        if len(self._files) < len(masks):
            self.said += f"; {len(masks) - len(self._files)} of {len(masks)} masks belong to no frame"

    def __getitem__(self, index: int) -> NDArray[np.bool_] | None:
        """Mask (H, W) of a frame, or None.

        Raises:
            FrameError: The image cannot be decoded.
            DatasetError: The image has another size.
        """
        file = self._files.get(index)
        if file is None:
            return None
        mask = read_mask(file)
        if mask.shape != self._shape:
            raise DatasetError(
                f"the mask {file} is {mask.shape[1]}x{mask.shape[0]} pixels, but the frames are "
                f"{self._shape[1]}x{self._shape[0]}; masks must have the size of the images"
            )
        return mask

    def files(self) -> dict[int, Path]:
        """Files by number of the frame, from 0."""
        return dict(sorted(self._files.items()))


def stamped_masks(folder: Path) -> list[tuple[float, Path]]:
    """Timestamps in seconds and paths of PNG files named by a time or number."""
    named = [(name, path) for path in sorted(folder.glob("*.png")) if (name := _core(path)) and _is_time(name)]
    unit = time_unit([float(name) for name, _ in named])
    return [(float(name) / unit.per_second, path) for name, path in named]


def are_counts(masks: Sequence[Path]) -> bool:
    """Whether names are small whole numbers, which are no times."""
    return bool(masks) and all(_is_count(_core(mask)) for mask in masks)


def _of_one_form(files: list[Path]) -> list[Path]:
    forms: dict[str, list[Path]] = {}
    for file in files:
        forms.setdefault(re.sub(NUMBER, "N", file.stem), []).append(file)
    return max(forms.values(), key=lambda form: ("mask" in form[0].stem.lower(), len(form)), default=[])


def _core(file: Path) -> str:
    return WORDS.sub("", file.stem)


def _is_time(name: str) -> bool:
    return re.fullmatch(rf"-?{NUMBER}", name) is not None


def _is_count(name: str) -> bool:
    return name.isdigit() and int(name) < LARGEST_NUMBER


def _by_name(masks: list[Path], images: Images) -> dict[int, Path]:
    found: dict[int, Path] = {}
    sides = list(zip(*images, strict=True))
    names = [{_core(file): index for index, file in enumerate(side)} for side in sides]
    names = [side for side in names if len(side) == len(images)]
    numbers = [side for files in sides if (side := _numbers(files))]
    for mask in masks:
        core, digits = _core(mask), re.findall(NUMBER, mask.stem)
        key = (len(digits), digits[-1]) if digits[-1].isdigit() else None
        index = next((side[core] for side in names if core in side), None)
        if index is None and key is not None:
            index = next((side[int(key[1])] for side in numbers if int(key[1]) in side), None)
        if index is None:
            continue
        if index in found:
            raise DatasetError(
                f"both {found[index].name} and {mask.name} in {mask.parent} are masks of frame {index}; expected one "
                "for a frame: move the other away"
            )
        found[index] = mask
    return found


def _numbers(files: Sequence[Path]) -> dict[int, int]:
    rows = [re.findall(NUMBER, file.stem) for file in files]
    for place in range(1, 1 + min(map(len, rows))):
        column = [row[-place] for row in rows]
        if all(text.isdigit() for text in column) and len({int(text) for text in column}) == len(files):
            return {int(text): index for index, text in enumerate(column)}
    return {}


def _by_time(
    path: Path, masks: list[Path], timestamps: NDArray[np.float64], taken: dict[int, Path], images: Images
) -> dict[int, Path]:
    counts = [mask for mask in masks if _is_count(_core(mask))]
    stamps = {float(_core(mask)): mask for mask in masks if mask not in counts and _is_time(_core(mask))}
    times = np.array(sorted(stamps))
    times_s = times / time_unit(times).per_second
    free = np.array([index for index in range(len(timestamps)) if index not in taken], dtype=int)
    pairs = associate(times_s, timestamps[free])
    if not pairs and not taken:
        if not stamps:
            known = "no image of the recording has such a number" if images else "the recording has no numbered images"
            raise DatasetError(
                f"none of the {len(masks)} masks in {path} belongs to a frame: they are named such as {masks[0].name}, "
                f"and {known}; expected the names of its images, or <timestamp>.png in seconds"
            )
        raise DatasetError(
            f"none of the {len(masks)} masks in {path} belongs to a frame: their times run from {times_s[0]:.6f} to "
            f"{times_s[-1]:.6f} s, the frames' from {timestamps[0]:.6f} to {timestamps[-1]:.6f} s; expected masks at "
            f"most {1000 * LARGEST_GAP:.0f} ms from a frame"
        )
    return {int(free[j]): stamps[float(times[i])] for i, j in pairs}
