"""How well found dynamic masks match the true ones, pixel by pixel."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.pipeline.metrics import SCORED_COVERAGE

Numbers = NDArray[np.float64]
Mask = NDArray[np.bool_]


class MaskPair(NamedTuple):
    """Seconds, and what was found to move and what truly moves, both (H, W)."""

    timestamp: float
    estimate: Mask
    reference: Mask


@dataclass(frozen=True, eq=False)
class MaskResult:
    """Comparison of found with true dynamic masks over N frames; NaN where a ratio has no pixels.

    Attributes:
        timestamps: (N,) seconds.
        coverage: (N,) share of the image that truly moves.
        found_share: (N,) share of the image that was found to move.
        precision: (N,) share of what was found that truly moves.
        recall: (N,) share of what truly moves that was found.
        iou: (N,) intersection over union.
        overall_precision: The same over the pixels of all frames together.
        overall_recall: The same over the pixels of all frames together.
        overall_iou: The same over the pixels of all frames together.
        mean_iou: Mean over the frames in which more than ``scored_coverage`` of the image truly moves.
        num_scored: Number of those.
        scored_coverage: See ``mean_iou``.
        false_alarm_share: Share of the image found to move, mean over the frames in which nothing does.
        num_missing: True masks without a found one.
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
    scored_coverage: float
    false_alarm_share: float
    num_missing: int


def compare_masks(
    pairs: Iterable[MaskPair], *, scored_coverage: float = SCORED_COVERAGE, num_missing: int = 0
) -> MaskResult:
    """Precision, recall and intersection over union, per frame and over all.

    Every pixel counts, with a depth reading or without.

    Args:
        pairs: Masks of the same frames.
        scored_coverage: Frames in which less of the image truly moves do not count for ``mean_iou``: the ratio of two
            small numbers says little.
        num_missing: True masks that have no partner, only passed on.

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
    scored, empty = coverage > scored_coverage, truth == 0
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
        scored_coverage=scored_coverage,
        false_alarm_share=float((found / size)[empty].mean()) if empty.any() else float("nan"),
        num_missing=num_missing,
    )


class MaskFolders:
    """The masks of a run and the true ones, paired by time.

    Args:
        estimate: Run folder with masks/, or a folder of PNG files named by their time stamp.
        reference: Recording in TUM layout with mask.txt, or a folder of PNG files named by their time stamp.

    Attributes:
        num_missing: True masks without a found one.

    Raises:
        DatasetError: A folder holds no masks, or none belong together.
    """

    def __init__(self, estimate: Path, reference: Path) -> None:
        from dudmap.geometry.association import associate

        found, true = _named_masks(estimate), _true_masks(reference)
        pairs = associate(np.array([stamp for stamp, _ in found]), np.array([stamp for stamp, _ in true]))
        if not pairs:
            raise DatasetError(
                f"no mask of {estimate} ({found[0][0]:.3f} to {found[-1][0]:.3f} s) lies within 20 ms of one of "
                f"{reference} ({true[0][0]:.3f} to {true[-1][0]:.3f} s); give the reference of the same recording"
            )
        self._pairs = [(true[j][0], found[i][1], true[j][1]) for i, j in sorted(pairs)]
        self.num_missing = len(true) - len(pairs)

    def __iter__(self) -> Iterator[MaskPair]:
        from dudmap.sequences.images import read_mask

        for stamp, found, true in self._pairs:
            yield MaskPair(stamp, read_mask(found), read_mask(true))


def _true_masks(folder: Path) -> list[tuple[float, Path]]:
    """Times and files of the true masks, by the depth images' times where associations.txt tells them."""
    from dudmap.geometry.association import associate, read_list, read_pairs

    if not (folder / "mask.txt").is_file():
        return _named_masks(folder)
    masks = read_list(folder / "mask.txt")
    if not (folder / "associations.txt").is_file():
        return [(mask.timestamp, mask.path) for mask in masks]
    frames = sorted(read_pairs(folder / "associations.txt"), key=lambda pair: pair[0].timestamp)
    colors = np.array([color.timestamp for color, _ in frames])
    pairs = associate(np.array([mask.timestamp for mask in masks]), colors)
    return sorted((frames[j][1].timestamp, masks[i].path) for i, j in pairs)


def _named_masks(folder: Path) -> list[tuple[float, Path]]:
    """PNG files named by their time stamp, of the folder itself or of its folder masks/."""
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}; expected a run folder or a folder of masks")
    masks = []
    for path in [*(folder / "masks").glob("*.png"), *folder.glob("*.png")]:
        try:
            masks.append((float(path.stem), path))
        except ValueError:
            continue
    if not masks:
        raise DatasetError(
            f"{folder} holds no masks (masks/<timestamp>.png or mask.txt); run with --save-masks to write them"
        )
    return sorted(masks)


def _ratio(part: Numbers, whole: Numbers) -> Numbers:
    return np.divide(part, whole, out=np.full(np.shape(whole), np.nan), where=np.asarray(whole) > 0)
