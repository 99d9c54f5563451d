"""Whether the map and an image have the same texture along a direction of motion.

Noise of the map's gradients adds to H (``observability.py``), and nothing in H tells it from what the scene shows. The
image has gradients of its own, whose noise is independent of the map's: the sum of products of the two is without that
bias. It is an instrumental variable, as errors in the variables of a regression ask for (Fuller 1987, Measurement error
models, section 1.4). This holds for the intensities alone. Errors of the distances are not independent: the depth
filter has a width in pixels and rounds the corners of a tunnel the more the farther they are, in every image alike, so
that the tunnel seems to narrow, and to move with the camera.
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.parameters import ImageStack, RegistrationParameters
from dudmap.core.formulas.residual import residual_weights
from dudmap.core.frames.observation import Level
from dudmap.core.tracking.observability import STEEPEST

ACROSS = 80
"""Readings across the image whose gradients are compared."""
MIN_AGREEMENT = 0.2
"""Share of the gradients, of distances and intensities together, that map and image have in common, from which on a
direction is shown. Noise gives 1 / sqrt(n) in n readings, 0.02; an endless tunnel and a wall without texture gave up to
0.06, walls with wallpaper of which H says no more than of those two 0.3 to 0.6 (rendered
corridors)."""


class GradientAgreement:
    """Compares the gradients of a linearisation with those of its image.

    Args:
        level: The image.
        residuals: (2, h, w) of the linearisation, NaN off the map.
        static: (h, w) static weights.
        R_world_camera: (3, 3).
        parameters: The weights of the residuals.
    """

    def __init__(
        self,
        level: Level,
        residuals: ImageStack,
        static: NDArray[np.float32],
        R_world_camera: NDArray[np.float64],
        parameters: RegistrationParameters,
    ) -> None:
        camera, stride = level.camera, max(1, level.camera.width // ACROSS)
        self._sampled = slice(1, -1, stride), slice(1, -1, stride)
        z = level.depth.astype(np.float64)
        rows, columns = np.mgrid[: camera.height, : camera.width]
        x = ((columns - camera.cx) / camera.fx)[self._sampled]
        y = ((rows - camera.cy) / camera.fy)[self._sampled]
        depth = z[self._sampled]
        known = depth > 0
        self._points = np.stack([x * depth, y * depth, depth], axis=-1)
        self._turn = R_world_camera.T

        def spatial(image: NDArray[np.float64]) -> NDArray[np.float64]:
            """Gradient (h, w, 3) of an image that is constant along each ray, camera axes, per metre."""
            across, down = (g[self._sampled] / np.where(known, depth, 1) for g in _differences(image))
            across, down = across * camera.fx, down * camera.fy
            return np.stack([across, down, -x * across - y * down], axis=-1)

        step = spatial(z)
        normal = step - (0.0, 0.0, 1.0)  # of the depth of the surface at a pixel, less that of a point there
        self._normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        self._shade = spatial(level.intensity.astype(np.float64))
        on_surface = known & _complete(z > 0)[self._sampled] & (np.hypot(step[..., 0], step[..., 1]) < STEEPEST)
        seen, static = np.stack([residuals[n][self._sampled] for n in (0, 1)]), static[self._sampled]
        self._valid = on_surface & np.isfinite(seen[1]) & (static > 0)
        self._weights = residual_weights(level.depth[self._sampled], seen, static, parameters)

    def along(self, twist: NDArray[np.float64], forth: ImageStack, back: ImageStack, step: float) -> float:
        """Share of the gradients along a twist that map and image have in common, in [-1, 1]: from the ``sums``

            sum w_c g_map g_image / sqrt(sum w g_map^2 sum w g_image^2),

        over the intensities above, over distances and intensities below.
        """
        of_map, _, of_image = (sums := self.sums(twist, forth, back, step)).sum(axis=0)
        return float(sums[1, 1] / max(np.sqrt(of_map * of_image), 1e-30))

    def sums(self, twist: NDArray[np.float64], forth: ImageStack, back: ImageStack, step: float) -> NDArray[np.float64]:
        """Sums of w g_map^2, w g_map g_image and w g_image^2 (columns) over distances and intensities (rows), w that of
        the registration.

        Args:
            twist: (6,) about the camera's centre, world axes.
            forth, back: Residuals (2, h, w) after a motion by ``step`` and ``-step`` times the twist.
            step: Of both.
        """
        motion = self._turn @ twist[:3] + np.cross(self._turn @ twist[3:], self._points)
        changes = [(forth[n][self._sampled] - back[n][self._sampled]) / (2 * step) for n in (0, 1)]
        valid, out = self._valid & np.isfinite(changes[1]), np.zeros((2, 3))
        for n, gradient in enumerate((self._normal, self._shade)):
            of_map, of_image = changes[n][valid], np.sum(gradient * motion, axis=-1)[valid]
            out[n] = np.sum(self._weights[n][valid] * (of_map**2, of_map * of_image, of_image**2), axis=1)
        return out


def _differences(image: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Central differences across and down, 0 at the border."""
    across, down = np.zeros_like(image), np.zeros_like(image)
    across[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    down[1:-1] = (image[2:] - image[:-2]) / 2
    return across, down


def _complete(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether the four neighbours of a pixel are known; False at the border."""
    out = np.zeros_like(known)
    out[1:-1, 1:-1] = known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1]
    return out
