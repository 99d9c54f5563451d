"""Ray tracing: exact depth, colour and primitive of every pixel."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import bands, run_bands
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.lab.synthetic.kernels import raytracing as kernels
from dudmap.lab.synthetic.scene import Primitive, Scene
from dudmap.lab.synthetic.textures import TEXTURES, build_atlas


def over_rows(count: int, work: Callable[..., None], *arguments: object) -> None:
    """Run ``work(row_from, row_to, *arguments)`` over ``count`` rows on all threads."""
    run_bands(lambda start, stop: work(start, stop, *arguments), bands(count, max(count // 10, 1)))


@dataclass(frozen=True, eq=False)
class Rendering:
    """Image of an ideal camera.

    Attributes:
        depth: (H, W) float32, metres, 0 = none.
        primitive: (H, W) int16, -1 = none.
        color: (H, W, 3) float32 in 0..255, or None.
        cosine: (H, W) float32, of the angle of incidence, or None.
    """

    depth: NDArray[np.float32]
    primitive: NDArray[np.int16]
    color: NDArray[np.float32] | None
    cosine: NDArray[np.float32] | None


class Renderer:
    """Renderer of fixed primitives at any poses: ``len(scene.primitives)`` static ones, then movers'; ``atlas``:
    textures."""

    def __init__(self, scene: Scene, primitives: list[Primitive]) -> None:
        self._scene = scene
        self._static = np.array([p.T_body_primitive for p in scene.primitives]).reshape(-1, 4, 4)
        self._kinds = np.array([p.kind for p in primitives], dtype=np.int32)
        self._halves = np.array([p.half for p in primitives], dtype=np.float64)
        self._bounds = np.array([p.bounds() for p in primitives])
        self._materials = np.array([p.material.row() for p in primitives], dtype=np.float64)
        self._textures = np.array([TEXTURES.index(p.material.texture) for p in primitives], dtype=np.int32)
        self.atlas = _atlas(frozenset(p.material.texture for p in primitives))

    def render(
        self,
        camera: Camera,
        T_world_camera: NDArray[np.float64],
        Ts_world_mover: NDArray[np.float64],
        present: NDArray[np.bool_],
        *,
        with_color: bool = True,
        gain: float = 1.0,
        vignette: float = 0.12,
    ) -> Rendering:
        """Render an image at T_world_camera (4, 4), without distortion.

        Args:
            Ts_world_mover: (M, 4, 4) of the movers' primitives.
            present: (M,) which exist.
            with_color: Also compute the colour.
            gain: Exposure factor of the colour.
            vignette: Brightness falls as 1 / (1 + vignette r^2), r from the axis at unit depth.
        """
        T_camera_world = se3.inverse(T_world_camera)
        Ts = T_camera_world @ np.concatenate([self._static, Ts_world_mover])
        exists = np.concatenate([np.ones(len(self._static), dtype=bool), present])
        rotations = np.ascontiguousarray(np.swapaxes(Ts[:, :3, :3], 1, 2))
        origins = -np.einsum("pij,pj->pi", rotations, Ts[:, :3, 3])
        order, nearest, columns, rows = self._bin(camera, Ts, exists)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        depth = np.empty(camera.shape, dtype=np.float32)
        ids = np.empty(camera.shape, dtype=np.int16)
        bins = (order, nearest, columns, rows)
        geometry = (self._kinds, rotations, origins, self._halves, intrinsics, depth, ids)
        over_rows(rows.shape[1], kernels.trace, *bins, *geometry)
        if not with_color:
            return Rendering(depth, ids, None, None)
        lights = np.array(
            [[*light.position, light.strength, light.falloff, light.softness] for light in self._scene.lights]
        )
        lights[:, :3] = lights[:, :3] @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        up = np.append(T_camera_world[:3, 2], self._scene.ambient)
        color = np.zeros((*camera.shape, 3), dtype=np.float32)
        cosines = np.empty(camera.shape, dtype=np.float32)
        look = (self._materials, self._textures, self.atlas, lights, up, np.array(self._scene.sky), vignette, gain)
        over_rows(rows.shape[1], kernels.shade, *geometry, *look, color, cosines)
        return Rendering(depth, ids, color, cosines)

    def _bin(
        self, camera: Camera, Ts: NDArray[np.float64], exists: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        center, axes = Ts[:, :3, 3], Ts[:, :3, :3] * self._bounds[:, None, :]
        reach = np.abs(axes[:, 2]).sum(axis=1)
        nearest = center[:, 2] - reach
        order = np.argsort(nearest, kind="stable")
        visible = exists & (center[:, 2] + reach > kernels.NEAR)
        touches = []
        for axis, size, tile, focal, middle in (
            (0, camera.width, kernels.TILE_WIDTH, camera.fx, camera.cx),
            (1, camera.height, kernels.TILE_HEIGHT, camera.fy, camera.cy),
        ):
            edges = np.append(np.arange(0, size, tile), size)
            low = (edges[:-1] - 0.5 - middle) / focal
            high = (edges[1:] - 0.5 - middle) / focal
            beyond_low = (
                center[:, axis, None] - low * center[:, 2, None]
                + np.abs(axes[:, axis, None] - low[:, None] * axes[:, 2, None]).sum(axis=2)
            )  # fmt: skip
            before_high = (
                center[:, axis, None] - high * center[:, 2, None]
                - np.abs(axes[:, axis, None] - high[:, None] * axes[:, 2, None]).sum(axis=2)
            )  # fmt: skip
            touches.append((beyond_low >= 0) & (before_high <= 0) & visible[:, None])
        order = order[visible[order] & touches[0].any(axis=1)[order] & touches[1].any(axis=1)[order]]
        return order, nearest, touches[0], touches[1]


@lru_cache(maxsize=4)
def _atlas(names: frozenset[str]) -> NDArray[np.int32]:
    return build_atlas(set(names))
