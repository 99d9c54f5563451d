"""Fidelity of a textured mesh at held-out views, against vertex colours."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import write_image
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import DatasetError
from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.exporting.view_synthesis import images_of
from dudmap.io.texturing.baking import TexturedMesh, textured
from dudmap.io.texturing.views import STRIDE, Views, aligned, drawn, groups, hit

HELD_OUT = 8
"""Groups of views per held-out one."""
INNER = 0.25
"""Weight of compared pixels, away from masks and depth edges."""
FINER = 2
"""Rendered pixels per image pixel, across and down."""
BACKGROUND = 32
"""Grey value of pixels without surface."""


@dataclass(frozen=True)
class TextureFidelity:
    """Result of ``measure_texture``.

    Attributes:
        views: Held-out views.
        texture_db, vertices_db: Peak signal-to-noise ratios, dB.
        seen: Share of texels that a view shows.
    """

    views: int
    texture_db: float
    vertices_db: float
    seen: float


def measure_texture(run: RunContent, options: ExportOptions, sheet: Path | None = None) -> TextureFidelity:
    """Texture a mesh from seven of eight groups of views, and render it at the others.

    Compared are static pixels of agreeing depth, covered by both meshes, away from masks and depth edges. Each image is
    registered to each rendering, with the best gain per channel. Vertex colours are of the full mesh and all frames.
    ``sheet``: rows of recorded image, vertex colours, texture.
    """
    recording = images_of(run, options)
    frames = groups(run, recording, options.every)
    held = frames[min(HELD_OUT // 2, len(frames) - 1) :: HELD_OUT]
    made = textured(run, options, [group for group in frames if group not in held])
    fine = edited(run.surface, ExportOptions(drop_pieces_below=options.drop_pieces_below, crop=options.crop))
    views = Views(run, recording, fine, level=False)
    errors, rows = np.zeros(2), []
    count = pixels = 0
    for view in views(held):
        shown = [rendered(mesh, view.T_world_camera, views.camera) for mesh in (made, fine)]
        used = (view.weights > INNER) & np.logical_and(*(covered for _, covered in shown))
        if not used.any():
            continue
        count, pixels, sides = count + 1, pixels + np.count_nonzero(used), [view.image]
        for number, (image, _) in enumerate(shown):
            height, width = (STRIDE * (size // STRIDE) for size in used.shape)
            sampled = image[STRIDE // 2 : height : STRIDE, STRIDE // 2 : width : STRIDE].astype(np.float32)
            columns, rows_ = aligned(view.image, sampled, view.weights)
            v, u = np.mgrid[: used.shape[0], : used.shape[1]].astype(np.float32)
            moved = cv2.remap(view.image, u + columns, v + rows_, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            given, wanted = image[used].astype(np.float64), np.asarray(moved)[used].astype(np.float64)
            gain = np.sum(given * wanted, axis=0) / np.maximum(np.sum(given**2, axis=0), 1)
            errors[number] += np.mean((np.clip(given * gain, 0, 255) - wanted) ** 2, axis=1).sum()
            sides.insert(1, np.clip(image * gain + 0.5, 0, 255).astype(np.uint8))
        rows.append(np.concatenate(sides, axis=1))
    if sheet is not None and rows:
        write_image(sheet, np.concatenate(rows, axis=0))
    if not pixels:
        raise DatasetError(
            f"none of the {len(held)} held-out views shows the mesh of {run.folder}; expected a longer run"
        )
    texture_db, vertices_db = 10 * np.log10(255**2 / np.maximum(errors / pixels, 1e-9))
    return TextureFidelity(count, float(texture_db), float(vertices_db), made.seen)


def rendered(
    mesh: Mesh | TexturedMesh, T_world_camera: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colour (h, w, 3) of a mesh, and covered pixels (h, w)."""
    fine = camera.resized(FINER * camera.width, FINER * camera.height)
    surface = mesh.mesh if isinstance(mesh, TexturedMesh) else mesh
    triangles, depth = drawn(surface, T_world_camera, fine)
    rows, columns = np.nonzero(triangles >= 0)
    corners, shares = hit(surface, T_world_camera, fine, rows, columns, triangles[rows, columns], depth)
    out = np.full((*triangles.shape, 3), BACKGROUND, np.uint8)
    if isinstance(mesh, TexturedMesh):
        place = np.einsum("nk,nkc->nc", shares, mesh.uv[corners]) * len(mesh.image) - 0.5
        columns_, rows_ = (np.full(triangles.shape, -1, np.float32) for _ in range(2))
        columns_[rows, columns], rows_[rows, columns] = place.T
        found = np.asarray(cv2.remap(mesh.image, columns_, rows_, cv2.INTER_LINEAR))
        out[rows, columns] = found[rows, columns]
    else:
        out[rows, columns] = np.rint(np.einsum("nk,nkc->nc", shares, surface.colors[corners]))
    size = camera.width, camera.height
    covered = np.asarray(cv2.resize((triangles >= 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)) > 0.99
    return np.asarray(cv2.resize(out, size, interpolation=cv2.INTER_AREA), np.uint8), covered
