"""Page of changes: both maps in 3D, and pictures of each change."""

import base64
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.app.viewing.report import Html, filled, html, joined, packed
from dudmap.app.viewing.snapshot import jpeg
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.mesh_simplification import simplified
from dudmap.fleet.change_evidence import Visit
from dudmap.fleet.changes import Change

TINTS = {
    "appeared": (60, 200, 90), "disappeared": (230, 60, 60), "moved": (60, 130, 255), "recoloured": (220, 120, 230),
}  # fmt: skip
STRENGTH = 0.65
"""Share of the tint in the colour of changed surface."""
TRIANGLES = 120_000
PICTURES = 40


def tinted(mesh: Mesh, changes: Sequence[Change], side: str) -> Mesh:
    """Mesh of a visit ("before" or "after") with tinted changes."""
    colors = mesh.colors.astype(np.float64)
    for change in changes:
        piece = getattr(change, side)
        if piece is not None and change.kind in TINTS:
            tint = STRENGTH * np.array(TINTS[change.kind])
            colors[piece.vertices] = (1 - STRENGTH) * colors[piece.vertices] + tint
    return replace(mesh, colors=np.rint(colors).astype(np.uint8))


def change_page(
    tree: dict[str, Any], meshes: Sequence[Mesh], visits: Sequence[Visit], poses: Sequence[NDArray[np.float64] | None]
) -> str:
    """HTML text of the page. Changes are rendered from their poses (4, 4), common frame."""
    data, texts = [], []
    for mesh in meshes:
        about, text = packed(simplified(mesh, TRIANGLES))
        data.append(about)
        texts.append(text)
    rows = []
    for row, pose in zip(tree["changes"], poses, strict=True):
        known = row["kind"] in TINTS
        pictures = _pictures(row, visits, pose) if known and pose is not None and row["id"] <= PICTURES else Html("")
        size = " x ".join(f"{100 * (b - a):.0f}" for a, b in zip(*row["box"], strict=True))
        text = f"{size} cm{motion_and_confidence(row)}" if known else f"{row['area']:.1f} m2 seen once"
        line = '<li data-id="{id}"><b class="{kind}">{id}. {kind}</b> <span>{text}</span>{pictures}</li>'
        rows.append(html(line, id=row["id"], kind=row["kind"], text=text, pictures=pictures))
    up = -np.mean([visit.keyframes[:, :3, 1].mean(axis=0) for visit in visits], axis=0)
    low, high = np.percentile(np.concatenate([visit.mesh.vertices[::20] for visit in visits]), [5, 95], axis=0)
    scene = {
        "meshes": data, "up": up.round(4).tolist(), "ahead": visits[0].keyframes[0][:3, 2].tolist(),
        "middle": ((low + high) / 2).tolist(), "size": float(np.linalg.norm(high - low)),
        "changes": [{key: row[key] for key in ("id", "kind", "box")} for row in tree["changes"]],
        "tints": {kind: int.from_bytes(bytes(tint), "big") for kind, tint in TINTS.items()},
    }  # fmt: skip
    counts = ", ".join(f"{count} {kind}" for kind, count in tree["counts"].items() if kind in TINTS)
    parts = {
        "title": f"{tree['before']} and {tree['after']}", "rows": joined(rows),
        "verdict": "; ".join([counts or "nothing changed", *tree["notes"]]),
        "before": texts[0], "after": texts[1],
        "tints": Html("".join(f".{kind} {{ color: rgb{tint} }}" for kind, tint in TINTS.items())),
    }  # fmt: skip
    return filled("changes", scene, parts)


def motion_and_confidence(row: dict[str, Any]) -> str:
    """Text on a thing's motion and confidence."""
    moved = ""
    if "distance" in row:
        moved = f", moved by {100 * row['distance']:.1f} ± {100 * row['distance_sigma']:.1f} cm"
        moved += f" and {row['turn_deg']:.1f} ± {row['turn_sigma_deg']:.1f} degrees"
        moved += " (ambiguous)" if "ambiguous" in row else ""
    return f"{moved}, confidence {row['confidence']:.2f}"


def _pictures(row: dict[str, Any], visits: Sequence[Visit], T: NDArray[np.float64]) -> Html:
    shown = []
    for name, visit in zip(("before", "after"), visits, strict=True):
        camera = visit.volume.camera.resized(
            320, max(1, round(320 * visit.volume.camera.height / visit.volume.camera.width))
        )
        image = visit.volume.raycast(np.linalg.inv(visit.T_common_map) @ T, camera).color
        data = "data:image/jpeg;base64," + base64.b64encode(jpeg(image.copy())).decode()
        shown.append(html('<img src="{data}" alt="{name}" title="{name}">', data=data, name=f"{row['id']} {name}"))
    return html('<span class="pair">{shown}</span>', shown=joined(shown))
