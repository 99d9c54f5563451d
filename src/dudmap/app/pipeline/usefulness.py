"""Whether a run is of use; else cause and remedy."""

import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

LEAST_SHARE = 0.1
"""Smallest share of frames in the largest map."""
MOST = 0.5
"""Share of measurements outside the depth range that explains failure."""


def uselessness(metrics: Mapping[str, Any], poses: int, depth_range: tuple[float, float]) -> str | None:
    """Sentence on a run with hardly any frame in the largest map (``poses``) or no triangle, or None."""
    frames = metrics["frames"]
    if poses < LEAST_SHARE * frames:
        found = f"{poses} of {frames} frames are in its largest map"
    elif not metrics["mesh_triangles"]:
        found = "its mesh is empty"
    else:
        return None
    why, remedy = _cause(metrics, depth_range)
    return f"this run is of no use: {found}; {why}; {remedy}"


def _cause(metrics: Mapping[str, Any], depth_range: tuple[float, float]) -> tuple[str, str]:
    for key, where, limit in zip(("too_near", "too_far"), ("nearer", "farther"), depth_range, strict=True):
        if (share := metrics["readings"][key]) > MOST:
            name = "near" if key == "too_near" else "far"
            return f"{share:.0%} of the depth readings are {where} than {limit:g} m", f"try --range {name}"
    reasons = [frame["reason"] for frame in metrics["lost_frames"]]
    if reasons:
        kinds = Counter(re.sub(r"\d+(\.\d+)?", "#", reason) for reason in reasons)
        kind, count = kinds.most_common(1)[0]
        example = next(reason for reason in reasons if re.sub(r"\d+(\.\d+)?", "#", reason) == kind)
        why = f"{count} of {len(reasons)} lost frames for one reason: {example}"
    else:
        why = f"{metrics['fused']} of {metrics['tracked']} tracked frames were fused"
    if metrics["warnings"]:
        return why, f"first mend the recording: {metrics['warnings'][0]}"
    return why, "look at the recording (dudmap info --sheet), and move the camera slowly past shapes and textures"
