"""Mask scores counted by hand."""

import cv2
import numpy as np
import pytest

from dudmap.errors import DatasetError
from dudmap.evaluation.segmentation import MaskPair, compare_masks, mask_pairs


def rectangle(height=10, width=20, rows=(0, 0), columns=(0, 0)):
    mask = np.zeros((height, width), bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def test_ratios_are_those_counted_by_hand():
    pairs = [
        MaskPair(0.0, rectangle(rows=(0, 5), columns=(0, 10)), rectangle(rows=(0, 5), columns=(5, 15))),
        MaskPair(0.1, rectangle(rows=(0, 2), columns=(0, 5)), rectangle()),
        MaskPair(0.2, rectangle(), rectangle(rows=(0, 4), columns=(0, 5))),
        MaskPair(0.3, rectangle(), rectangle()),
        MaskPair(0.4, rectangle(rows=(0, 2), columns=(0, 2)), rectangle(rows=(0, 2), columns=(0, 2))),
    ]
    result = compare_masks(pairs, num_missing=7)
    np.testing.assert_allclose(result.coverage, [0.25, 0, 0.1, 0, 0.02])
    np.testing.assert_allclose(result.found_share, [0.25, 0.05, 0, 0, 0.02])
    np.testing.assert_allclose(result.precision, [0.5, 0, np.nan, np.nan, 1])
    np.testing.assert_allclose(result.recall, [0.5, np.nan, 0, np.nan, 1])
    np.testing.assert_allclose(result.iou, [25 / 75, 0, 0, np.nan, 1])
    assert result.num_scored == 2
    assert result.mean_iou == pytest.approx((25 / 75 + 0) / 2)
    assert result.overall_precision == pytest.approx((25 + 4) / (50 + 10 + 4))
    assert result.overall_recall == pytest.approx((25 + 4) / (50 + 20 + 4))
    assert result.overall_iou == pytest.approx(29 / (64 + 74 - 29))
    assert result.false_alarm_share == pytest.approx(0.025)
    assert result.num_missing == 7


def test_nothing_moves_and_nothing_is_found():
    result = compare_masks([MaskPair(0.0, rectangle(), rectangle())])
    assert result.num_scored == 0
    assert np.isnan(result.mean_iou)
    assert np.isnan(result.overall_iou)
    assert result.false_alarm_share == 0


def write_masks(folder, stamps, subfolder="masks"):
    """Mask number k has its first k + 1 rows set."""
    (folder / subfolder).mkdir(parents=True)
    for k, stamp in enumerate(stamps):
        cv2.imwrite(str(folder / subfolder / f"{stamp:.6f}.png"), rectangle(rows=(0, k + 1), columns=(0, 20)) * 255)
    return folder


def test_true_masks_are_named_by_colour_and_found_ones_by_depth(tmp_path):
    """Colour comes 15 ms before its depth at 30 ms per frame, so that nearest times alone would pair wrongly."""
    depths = 5 + 0.03 * np.arange(6)
    run = write_masks(tmp_path / "run", depths[:5])
    reference = write_masks(tmp_path / "recording", depths - 0.018, "mask")
    lines = [f"{t - 0.018:.6f} mask/{t - 0.018:.6f}.png" for t in depths]
    (reference / "mask.txt").write_text("\n".join(lines) + "\n")
    assert compare_masks(*mask_pairs(run, reference)).mean_iou < 0.9
    lines = [f"{t - 0.018:.6f} rgb/{t}.png {t:.6f} depth/{t}.png" for t in depths]
    (reference / "associations.txt").write_text("\n".join(lines) + "\n")
    result = compare_masks(*mask_pairs(run, reference))
    assert result.mean_iou == 1
    assert result.num_missing == 1
    np.testing.assert_allclose(result.timestamps, depths[:5])


def test_two_folders_of_masks(tmp_path):
    stamps = [1.0, 1.1, 1.2]
    first, second = write_masks(tmp_path / "a", stamps), write_masks(tmp_path / "b", stamps)
    (second / "masks" / "readme.png").write_bytes(b"not named by a time")
    assert compare_masks(*mask_pairs(first, second / "masks")).overall_iou == 1


def test_errors_are_one_sentence(tmp_path):
    run = write_masks(tmp_path / "run", [1.0, 1.1])
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="run with --save-masks"):
        mask_pairs(tmp_path / "empty", run)
    with pytest.raises(DatasetError, match="there is no folder"):
        mask_pairs(tmp_path / "none", run)
    with pytest.raises(DatasetError, match=r"within 20 ms of one of .* \(9\.000 to 9\.100 s\)"):
        mask_pairs(run, write_masks(tmp_path / "late", [9.0, 9.1]))
    with pytest.raises(DatasetError, match="20x10 pixels but the true one is 20x12"):
        compare_masks([MaskPair(0.0, rectangle(), rectangle(height=12))])
    with pytest.raises(DatasetError, match="nothing can be compared"):
        compare_masks([])
