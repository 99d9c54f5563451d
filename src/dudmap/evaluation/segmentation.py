"""Pixel-wise comparison of estimated dynamic masks with the true ones."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import associate, read_list, read_pairs
from dudmap.errors import DatasetError, DudmapError
from dudmap.input_files import DAMAGE, describe, read_json
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.images import read_mask
from dudmap.io.sequences.masks import MaskFolder, are_counts, stamped_masks

Numbers = NDArray[np.float64]
Mask = NDArray[np.bool_]

SCORED_COVERAGE = 0.05
"""Smallest true share of the image that counts for the mean intersection over union."""


class MaskPair(NamedTuple):
    """Timestamp in seconds, estimated and true mask (H, W)."""

    timestamp: float
    estimate: Mask
    reference: Mask


@dataclass(frozen=True, eq=False)
class MaskResult:
    """Estimated against true dynamic masks of N frames; NaN for no pixels.

    Attributes:
        timestamps: (N,) seconds.
        coverage: (N,) dynamic share of the image, true.
        found_share: (N,) dynamic share of the image, estimated.
        precision: (N,) share of the estimated mask in the true one.
        recall: (N,) share of the true mask in the estimated one.
        iou: (N,) intersection over union.
        mean_iou: Over frames with ``coverage`` above ``SCORED_COVERAGE``.
        false_alarm_share: Mean ``found_share`` of frames with an empty true mask.
    """

    timestamps: Numbers
    coverage: Numbers
    found_share: Numbers
    precision: Numbers
    recall: Numbers
    iou: Numbers
    overall_precision: float
    overall_recall: float
    overall_iou: float
    mean_iou: float
    num_scored: int
    false_alarm_share: float
    num_missing: int


def mask_iou(estimate: Mask, reference: Mask) -> float:
    """Intersection over union of two masks (H, W), not both empty."""
    return np.count_nonzero(estimate & reference) / np.count_nonzero(estimate | reference)


def compare_masks(pairs: Iterable[MaskPair], num_missing: int = 0) -> MaskResult:
    """Precision, recall and intersection over union, per frame and over all.

    Args:
        pairs: Estimated and true masks.
        num_missing: True masks without partner, for the result.

    Raises:
        DatasetError: There is no pair, or two masks differ in size.
    """
    rows = []
    for stamp, found, truth in pairs:
        if found.shape != truth.shape:
            raise DatasetError(
                f"at {stamp:.6f} s the found mask is {found.shape[1]}x{found.shape[0]} pixels but the true one is "
                f"{truth.shape[1]}x{truth.shape[0]}; give the masks of the same recording"
            )
        rows.append(
            (stamp, truth.size, np.count_nonzero(found & truth), np.count_nonzero(found), np.count_nonzero(truth))
        )
    if not rows:
        raise DatasetError("there is no frame with a found and a true mask; nothing can be compared")
    stamps, size, both, found, truth = np.array(rows, dtype=np.float64).T
    iou, coverage = _ratio(both, found + truth - both), truth / size
    scored, empty = coverage > SCORED_COVERAGE, truth == 0
    total_both, total_found, total_true = both.sum(), found.sum(), truth.sum()
    return MaskResult(
        timestamps=stamps,
        coverage=coverage,
        found_share=found / size,
        precision=_ratio(both, found),
        recall=_ratio(both, truth),
        iou=iou,
        overall_precision=float(_ratio(total_both, total_found)),
        overall_recall=float(_ratio(total_both, total_true)),
        overall_iou=float(_ratio(total_both, total_found + total_true - total_both)),
        mean_iou=float(iou[scored].mean()) if scored.any() else float("nan"),
        num_scored=int(np.count_nonzero(scored)),
        false_alarm_share=float((found / size)[empty].mean()) if empty.any() else float("nan"),
        num_missing=num_missing,
    )


def mask_pairs(estimate: Path, reference: Path) -> tuple[Iterator[MaskPair], int]:
    """Estimated and true masks, paired by time and read one by one.

    Args:
        estimate: Run folder, or PNG files named by time stamp.
        reference: TUM layout with mask.txt, or PNG files named by time stamps or image numbers.

    Returns:
        The pairs, and the number of unpaired true masks.

    Raises:
        DatasetError: A folder holds no masks, or no two masks are close enough in time.
    """
    found, true = _estimated_masks(estimate), _true_masks(reference)
    if are_counts([mask for _, mask in true]) and not are_counts([mask for _, mask in found]):
        true = _numbered_masks(reference, estimate)
    pairs = associate(np.array([stamp for stamp, _ in found]), np.array([stamp for stamp, _ in true]))
    if not pairs:
        raise DatasetError(
            f"no mask of {estimate} ({found[0][0]:.3f} to {found[-1][0]:.3f} s) lies within 20 ms of one of "
            f"{reference} ({true[0][0]:.3f} to {true[-1][0]:.3f} s); give the reference of the same recording"
        )
    read = (MaskPair(true[j][0], read_mask(found[i][1]), read_mask(true[j][1])) for i, j in sorted(pairs))
    return read, len(true) - len(pairs)


def _true_masks(folder: Path) -> list[tuple[float, Path]]:
    if not (folder / "mask.txt").is_file():
        return _estimated_masks(folder)
    masks = read_list(folder / "mask.txt")
    if not (folder / "associations.txt").is_file():
        return [(mask.timestamp, mask.path) for mask in masks]
    frames = sorted(read_pairs(folder / "associations.txt"), key=lambda pair: pair[0].timestamp)
    colors = np.array([color.timestamp for color, _ in frames])
    pairs = associate(np.array([mask.timestamp for mask in masks]), colors)
    return sorted((frames[j][1].timestamp, masks[i].path) for i, j in pairs)


def _numbered_masks(folder: Path, run: Path) -> list[tuple[float, Path]]:
    try:
        recording = open_sequence(**read_json(run / "metrics.json")["recording"])
    except (DudmapError, *DAMAGE) as error:
        raise DatasetError(
            f"the masks in {folder} are named by numbers, the masks of {run} by times, and the recording of the run "
            f"cannot be opened ({describe(error)}); expected masks named <timestamp>.png"
        ) from error
    masks = MaskFolder(folder, recording.timestamps, recording.camera, getattr(recording, "image_files", ()))
    return [(float(recording.timestamps[index]), file) for index, file in masks.files().items()]


def _estimated_masks(folder: Path) -> list[tuple[float, Path]]:
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}; expected a run folder or a folder of masks")
    masks = [*stamped_masks(folder / "masks"), *stamped_masks(folder)]
    if not masks:
        raise DatasetError(
            f"{folder} holds no masks (masks/<timestamp>.png or mask.txt); run with --save-masks to write them"
        )
    return sorted(masks)


def _ratio(part: Numbers, whole: Numbers) -> Numbers:
    return np.divide(part, whole, out=np.full(np.shape(whole), np.nan), where=np.asarray(whole) > 0)
