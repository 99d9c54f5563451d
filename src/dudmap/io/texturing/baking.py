"""Bake a texture: atlas, texel colours from the best views, filled gaps."""

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.texturing import OCTAVE, OCTAVES, draw_triangles, gather_colors
from dudmap.core.backends.threads import bands, run_bands
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import ConfigError, DatasetError
from dudmap.extras import extra
from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.exporting.view_synthesis import images_of
from dudmap.io.texturing.views import Taken, View, Views, groups

log = logging.getLogger(__name__)
SIZES = 64, 8192
"""Smallest and largest texture, pixels; 8192 takes 2 GB."""
TRIANGLES = 40_000
"""Triangles of a textured mesh by default: an atlas takes ten seconds."""
PADDING = 3
"""Texels that continue a chart, for interpolation and reduced images."""
COARSER = 4
"""Width reduction of the first pass, registered to vertex colours; the second is registered to its sharper texture."""
BEST = 3
"""Views mixed in a texel."""
SHARP = 2.0
"""Exponent of the weights in the mixture."""
STEEPEST = 0.2
"""Smallest cosine between viewing ray and normal."""
ROWS = 64
"""Rows that a thread fills at a time."""


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh with a texture.

    Attributes:
        mesh: Seam vertices are repeated.
        uv: (V, 2) float32 place in the image, (0, 0) upper left to (1, 1).
        image: (S, S, 3) uint8.
        seen: Share of the surface's texels that a view shows; others have vertex colours.
    """

    mesh: Mesh
    uv: NDArray[np.float32]
    image: NDArray[np.uint8]
    seen: float

    def colors(self, corners: NDArray[np.int32], shares: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Colours (n, 3) between corners (n, 3) with shares (n, 3)."""
        import cv2

        place = np.einsum("nk,nkc->nc", shares, self.uv[corners]) * len(self.image) - 0.5
        u, v = np.zeros((2, -(-len(place) // ROWS) * ROWS), np.float32)
        u[: len(place)], v[: len(place)] = place.T
        found = cv2.remap(self.image, u.reshape(-1, ROWS), v.reshape(-1, ROWS), cv2.INTER_LINEAR)
        return np.asarray(found, np.uint8).reshape(-1, 3)[: len(place)]


def textured(run: RunContent, options: ExportOptions, chosen: "list[list[Taken]] | None" = None) -> TexturedMesh:
    """The edited mesh of a run, textured from its images by ``texture``, ``sequence``, ``every``; ``chosen``: frames,
    None for all.

    Raises:
        ConfigError: The size is out of range.
        NoImagesError: The run has no images.
        DatasetError: No masks, poses of another recording, or no colour.
        MissingExtraError: xatlas or fast-simplification is not installed.
    """
    size = options.texture or 0
    if not SIZES[0] <= size <= SIZES[1]:
        raise ConfigError(f"found a texture of {size} pixels; expected {SIZES[0]} to {SIZES[1]}, such as 4096")
    recording = images_of(run, options)
    fine = edited(run.surface, replace(options, max_triangles=None))
    mesh, uv = unwrapped(with_mean_colors(edited(fine, _reduced(options)), fine), size)
    frames = groups(run, recording, options.every) if chosen is None else chosen
    log.info("texture of %dx%d for %d triangles: two passes over %d views", size, size, len(mesh.faces), len(frames))
    first = _baked(Views(run, recording, mesh), frames, fine, mesh, uv, -(-size // COARSER))
    made = _baked(Views(run, recording, mesh, first.colors), frames, fine, mesh, uv, size)
    log.info("images colour %.0f %% of the surface, vertex colours the rest", 100 * made.seen)
    return made


def _baked(
    views: Views, frames: list[list[Taken]], fine: Mesh, mesh: Mesh, uv: NDArray[np.float32], size: int
) -> TexturedMesh:
    numbers, A = _texels(mesh, uv, size), places(mesh, uv, size)
    found, colors = np.zeros((size, size, BEST), np.uint16), np.zeros((size, size, BEST, 3), np.uint8)
    for view in views(frames):
        _gather(view, mesh, A, views.camera, numbers, found, colors)
    image, seen = np.zeros((size, size, 3), np.uint8), found[..., 0] > 0
    if not seen.any():
        raise DatasetError("no image of the run shows its mesh in colour; leave out --texture")
    for start, stop in bands(size, ROWS):
        steps = found[start:stop].astype(np.float32)
        weights = np.where(steps > 0, np.exp2((steps - steps[..., :1]) * np.float32(SHARP / OCTAVE)), 0)
        total = np.maximum(weights.sum(axis=2), 1)
        mixed = np.einsum("yxk,yxkc->yxc", weights, colors[start:stop].astype(np.float32)) / total[..., None]
        image[start:stop] = np.rint(mixed)
    del found, colors  # a third of a gigabyte
    on_mesh = numbers >= 0
    rows, columns = np.nonzero(on_mesh & ~seen)
    image[rows, columns] = _vertex_colors(fine, A, numbers[rows, columns], columns, rows)
    return TexturedMesh(mesh, uv, _continued(image, on_mesh), float(seen.sum() / max(1, on_mesh.sum())))


def _reduced(options: ExportOptions) -> ExportOptions:
    return ExportOptions(max_triangles=options.max_triangles or TRIANGLES, drop_pieces_below=0.0)


def with_mean_colors(mesh: Mesh, fine: Mesh) -> Mesh:
    """Mesh with the mean colours of the nearest vertices of a finer one."""
    from scipy.spatial import KDTree

    _, nearest = KDTree(mesh.vertices).query(fine.vertices, workers=-1)
    count = np.bincount(nearest, minlength=len(mesh.vertices))
    sums = [np.bincount(nearest, fine.colors[:, k], len(mesh.vertices)) for k in range(3)]
    mean = np.rint(np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]).astype(np.uint8)
    return replace(mesh, colors=np.where(count[:, None] > 0, mean, mesh.colors))


def unwrapped(mesh: Mesh, size: int) -> tuple[Mesh, NDArray[np.float32]]:
    """Mesh cut along the seams of an atlas, and places (V, 2), 0 to 1."""
    with extra("texture", "--texture"):
        import xatlas

    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    atlas.add_mesh(mesh.vertices, mesh.faces.astype(np.uint32))
    packing.resolution, packing.padding = size, PADDING
    atlas.generate(xatlas.ChartOptions(), packing)
    origin, faces, uv = atlas[0]
    parts = (mesh.vertices[origin], faces.astype(np.int32), mesh.colors[origin], mesh.normals[origin])
    return Mesh(*parts), uv.astype(np.float32)


def _texels(mesh: Mesh, uv: NDArray[np.float32], size: int) -> NDArray[np.int32]:
    points = np.column_stack([uv * np.float32(size) - np.float32(0.5), np.ones(len(uv), np.float32)])
    numbers, distances = np.full((size, size), -1, np.int32), np.full((size, size), np.inf, np.float32)
    draw_triangles(points, mesh.faces, np.float32(PADDING / 2), numbers, distances)
    return numbers


def places(mesh: Mesh, uv: NDArray[np.float32], size: int) -> NDArray[np.float64]:
    """(F, 3, 3) maps texel (column, row, 1) of a triangle to its point; 0 without surface."""
    corners = np.ones((len(mesh.faces), 3, 3))
    corners[:, :2] = (uv[mesh.faces].astype(np.float64) * size - 0.5).transpose(0, 2, 1)
    out, flat = np.zeros_like(corners), np.abs(np.linalg.det(corners)) < 1e-6
    points = mesh.vertices[mesh.faces].astype(np.float64).transpose(0, 2, 1)
    out[~flat] = points[~flat] @ np.linalg.inv(corners[~flat])
    return out


def _gather(
    view: View,
    mesh: Mesh,
    A: NDArray[np.float64],
    camera: Camera,
    numbers: NDArray[np.int32],
    found: NDArray[np.uint16],
    colors: NDArray[np.uint8],
) -> None:
    T = se3.inverse(view.T_world_camera)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    normal, ray = np.cross(b - a, c - a), (a + b + c) / 3 - view.T_world_camera[:3, 3]
    z = ray @ view.T_world_camera[:3, 2]
    cosine = -np.sum(normal * ray, axis=1) / np.maximum(
        np.linalg.norm(normal, axis=1) * np.linalg.norm(ray, axis=1), 1e-12
    )
    u, v = camera.project(np.column_stack([ray @ view.T_world_camera[:3, 0], ray @ view.T_world_camera[:3, 1], z])).T
    reach = camera.width / 4
    with np.errstate(invalid="ignore"):
        visible = (cosine > STEEPEST) & (z > 0) & (u > -reach) & (v > -reach)
        visible &= (u < camera.width + reach) & (v < camera.height + reach)
    quality = np.where(visible, cosine / np.maximum(z, 0.1) ** 2, 0)
    slope = np.sqrt(np.maximum(1 - cosine**2, 0)) / np.maximum(cosine, STEEPEST)
    tolerance = z / camera.fx * (1 + slope)
    H = camera.K @ (T[:3, :3] @ A + T[:3, 3:] * np.array([0, 0, 1.0]))
    arrays = H.astype(np.float32), _steps(quality), tolerance.astype(np.float32), view.depth, _steps(view.weights)

    def fill(start: int, stop: int) -> None:
        gather_colors(start, stop, numbers, *arrays, view.image, found, colors)

    run_bands(fill, bands(len(numbers), ROWS))


def _steps(weights: NDArray) -> NDArray[np.int32]:
    steps = 1 + OCTAVE * (OCTAVES + np.log2(np.maximum(weights, 2.0**-OCTAVES)))
    return np.where(weights > 0, np.rint(steps), 0).astype(np.int32)


def _vertex_colors(
    fine: Mesh, A: NDArray[np.float64], faces: NDArray[np.int32], columns: NDArray[np.intp], rows: NDArray[np.intp]
) -> NDArray[np.uint8]:
    from scipy.spatial import KDTree

    out, tree = np.empty((len(faces), 3), np.uint8), KDTree(fine.vertices)
    for first in range(0, len(faces), 1 << 18):
        part = slice(first, first + (1 << 18))
        texels = np.stack([columns[part], rows[part], np.ones_like(rows[part])], axis=1)
        distance, nearest = tree.query(np.einsum("nij,nj->ni", A[faces[part]], texels), k=3, workers=-1)
        weights = 1 / np.maximum(distance, 1e-4)
        mean = np.einsum("nk,nkc->nc", weights, fine.colors[nearest]) / weights.sum(axis=1, keepdims=True)
        out[part] = np.rint(mean)
    return out


def _continued(image: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Image whose unknown texels, given as 0, continue the known ones."""
    import cv2

    if min(image.shape[:2]) == 1:
        return image
    half = tuple((size + 1) // 2 for size in known.shape[::-1])
    share = np.asarray(cv2.resize(known.view(np.uint8) * np.uint8(255), half, interpolation=cv2.INTER_AREA))
    sums = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
    for start, stop in bands(len(sums), ROWS):
        part = share[start:stop, :, None] / np.float32(255)
        sums[start:stop] = np.clip(sums[start:stop] / np.maximum(part, np.float32(1e-3)), 0, 255)
    coarse = _continued(sums, share > 0)
    full = np.asarray(cv2.resize(coarse, known.shape[::-1], interpolation=cv2.INTER_LINEAR), np.uint8)
    np.copyto(image, full, where=~known[..., None])
    return image
