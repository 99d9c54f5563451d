"""Directions of motion that a view does not determine, found from H (Zhang, Kaess and Singh 2016, On degeneracy of
optimization-based state estimation problems)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.gradient_noise import NUM_SUMS, noise_information
from dudmap.core.backends.parameters import ImageStack, RegistrationParameters, single
from dudmap.core.formulas.residual import residual_weights
from dudmap.core.frames.observation import Level

INTENSITY_SIGMA = 1 / 255
"""Standard deviation of a voxel's intensity: the storage step."""
SAMPLES_ACROSS, MIN_SAMPLES = 40, 10
"""Samples across the image for the noise of H, and fewest samples on the map."""
INTERPOLATED = 2 * (2 / 3) ** 2
"""Gradient variance of trilinearly interpolated independent values of variance 1, averaged over a cell: two means over
four edges, whose weights a (1 - a) square to (2/3)^2."""
STEEPEST = 9.5
"""Tangent of the angle of incidence (84 degrees) beyond which sensors return no depth."""
REGULAR = 1e-6
"""Relative increase of the diagonal of the noise."""
AXES = "sideways", "up and down", "forwards", "nodding", "turning", "rolling"
"""Motions along and about the camera's x, y and z."""


@dataclass(frozen=True, eq=False)
class Observability:
    """Directions of a twist (v, omega) about the camera's centre that a registration determines.

    Attributes:
        observable: (6, m) basis, world axes.
        unobservable: (6 - m, 6) other directions, camera axes, of unit length if one radian counts as the mean depth.
    """

    observable: NDArray[np.float64]
    unobservable: NDArray[np.float64]

    @property
    def is_complete(self) -> bool:
        """Whether all directions are determined."""
        return len(self.unobservable) == 0

    def with_shown(self, shown: NDArray[np.bool_], R_world_camera: NDArray[np.float64]) -> "Observability":
        """Copy in which the unobservable directions ``shown`` (k,) are observable."""
        if shown.all():
            return COMPLETE
        more = np.kron(np.eye(2), R_world_camera) @ self.unobservable[shown].T
        return Observability(np.hstack([self.observable, more]), self.unobservable[~shown])


COMPLETE = Observability(np.eye(6), np.empty((0, 6)))
"""All directions are determined."""


@dataclass(frozen=True, eq=False)
class GradientNoise:
    """Information in H from gradient noise alone.

    Attributes:
        distances, intensities: (6, 6) of the two terms, world axes.
        variances: Mean gradient variances of the two terms.
        depth: Mean depth, metres.
    """

    distances: NDArray[np.float64]
    intensities: NDArray[np.float64]
    variances: tuple[float, float]
    depth: float

    def observability(
        self,
        H_distances: NDArray[np.float64],
        H: NDArray[np.float64],
        R_world_camera: NDArray[np.float64],
        least: float,
    ) -> Observability:
        """Directions in which the information of both terms exceeds the noise.

        Gradient noise gives E[H] = H_true + N. In unobserved directions H is N, and the registration fits noise. Each
        term counts by its gradient variance s^2. The generalised eigenvalues of

            (H_d / s_d^2 + H_c / s_c^2) v = mu (N_d / s_d^2 + N_c / s_c^2) v

        are 1 for pure noise, independent of the units of translation and rotation.

        Args:
            H_distances: (6, 6) normal equations of the distances alone, world axes.
            H: (6, 6) of both terms.
            R_world_camera: (3, 3).
            least: Smallest eigenvalue of a determined direction.
        """
        s_d, s_c = self.variances
        information, noise = H_distances / s_d, self.distances / s_d
        if s_c > 0:
            information, noise = information + (H - H_distances) / s_c, noise + self.intensities / s_c
        ratios, directions = _eigenvalues(information, noise)
        if ratios[0] >= least:
            return COMPLETE
        free = np.kron(np.eye(2), R_world_camera.T) @ directions[:, ratios < least]
        lengths = np.sqrt(np.sum(free[:3] ** 2, axis=0) + self.depth**2 * np.sum(free[3:] ** 2, axis=0))
        return Observability(directions[:, ratios >= least], (free / lengths).T)


def _eigenvalues(H: NDArray[np.float64], noise: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ascending solutions of ``H v = mu noise v``; eigenvectors in columns."""
    factor = np.linalg.inv(np.linalg.cholesky(noise))
    ratios, vectors = np.linalg.eigh(factor @ H @ factor.T)
    return ratios, np.asarray(factor.T @ vectors, dtype=np.float64)


def gradient_noise(
    level: Level,
    residuals: ImageStack,
    weights: NDArray[np.float32],
    R_world_camera: NDArray[np.float64],
    voxel_size: float,
    map_width: int,
    filter_px: float,
    parameters: RegistrationParameters,
    H: NDArray[np.float64],
    least: float,
) -> GradientNoise | None:
    """Information in H from gradient noise in a view.

    * Filtered noise: standard deviation sigma per pixel of size a, smoothed by a Gaussian of width s, has the gradient
      variance sigma^2 a^2 / (8 pi s^4). s combines the filter and half a voxel.
    * Sampling: a voxel takes the nearest pixel, with an error uniform over the depth step g between two pixels.
      Trilinear interpolation gives the gradient variance 2 (2/3)^2 g^2 / 12 / voxel^2.
    * Intensities of neighbouring voxels are independent: 2 (2/3)^2 sigma_I^2 / voxel^2.

    A measurement at p from the camera centre contributes its variance times J' J with J = [I, -hat(p)].

    Args:
        level: The image.
        residuals: (2, h, w) of the linearisation, NaN off the map.
        weights: (h, w) static weights.
        R_world_camera: (3, 3).
        voxel_size: Metres.
        map_width: Width of the map's source images, pixels.
        filter_px: Spatial standard deviation of their depth filter, pixels.
        parameters: The weights of the residuals.
        H: (6, 6) normal equations of both terms, world axes.
        least: Smallest information of a determined direction, in units of the noise.

    Returns:
        None in these cases: H exceeds ``least`` times the noise in every direction; too few measurements are on the
            map; source pixels are wider than voxels, to which this model does not apply.
    """
    camera, stride = level.camera, max(1, level.camera.width // SAMPLES_ACROSS)
    scale = camera.width / map_width
    s_c = INTERPOLATED * (INTENSITY_SIGMA / voxel_size) ** 2 if parameters.color_weight > 0 else 0.0
    sums, noise = np.zeros(NUM_SUMS), np.empty((2, 6, 6))
    exceeded = noise_information(
        stride, level.depth, (residuals[0], residuals[1]), weights, camera.intrinsics, single(parameters),
        (filter_px * scale, scale, voxel_size, INTERPOLATED, STEEPEST), R_world_camera, s_c, REGULAR, H, least, sums,
        noise,
    )  # fmt: skip
    count, depth, weight = sums[:3]
    if exceeded or count < MIN_SAMPLES or depth / count / camera.fx * scale > voxel_size:
        return None
    s_d = sums[3] / max(weight, 1e-12)
    return GradientNoise(noise[0], noise[1], (max(s_d, 1e-12), s_c), depth / count)


def unobserved_motion(unobservable: NDArray[np.float64]) -> str:
    """Why a pose is uncertain: the unobservable directions (k, 6); empty if there are none."""
    if len(unobservable) == 0:
        return ""
    strongest = np.abs(unobservable).max(axis=0)
    named = [name for name, share in zip(AXES, strongest, strict=True) if share > 0.5 * strongest.max()]
    return f"the view does not show how the camera moves in {len(unobservable)} direction(s): {', '.join(named)}"


ACROSS = 80
"""Compared gradients across the image."""
MIN_AGREEMENT = 0.2
"""Smallest correlation of map and image gradients along an observed direction. n noisy measurements give 1 / sqrt(n),
0.02; untextured rendered scenes gave up to 0.06, papered walls 0.3 to 0.6."""


class GradientAgreement:
    """Compares the gradients of a linearisation with the image gradients.

    Noise of the map's gradients cannot be separated within H. The image has independent noise, so that products of both
    are unbiased: an instrumental variable (Fuller 1987, Measurement error models, section 1.4). Only intensities have
    independent errors, because the depth filter rounds distant corners alike in every image.

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
        normal = step - (0.0, 0.0, 1.0)  # depth gradient of the surface minus the depth gradient of a point
        self._normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        self._shade = spatial(level.intensity.astype(np.float64))
        on_surface = known & _complete(z > 0)[self._sampled] & (np.hypot(step[..., 0], step[..., 1]) < STEEPEST)
        seen, static = np.stack([residuals[n][self._sampled] for n in (0, 1)]), static[self._sampled]
        self._valid = on_surface & np.isfinite(seen[1]) & (static > 0)
        self._weights = residual_weights(level.depth[self._sampled], seen, static, parameters)

    def along(self, twist: NDArray[np.float64], forth: ImageStack, back: ImageStack, step: float) -> float:
        """Correlation in [-1, 1] of map and image gradients along a twist, from the ``sums``

            sum w_c g_map g_image / sqrt(sum w g_map^2 sum w g_image^2).

        The numerator holds intensities alone.
        """
        of_map, _, of_image = (sums := self.sums(twist, forth, back, step)).sum(axis=0)
        return float(sums[1, 1] / max(np.sqrt(of_map * of_image), 1e-30))

    def sums(self, twist: NDArray[np.float64], forth: ImageStack, back: ImageStack, step: float) -> NDArray[np.float64]:
        """Sums of w g_map^2, w g_map g_image and w g_image^2 (columns) over distances and intensities (rows).

        Args:
            twist: (6,) about the camera's centre, world axes.
            forth, back: Residuals (2, h, w) after a motion by ``step`` and ``-step`` times the twist.
            step: Step of both motions.
        """
        motion = self._turn @ twist[:3] + np.cross(self._turn @ twist[3:], self._points)
        changes = [(forth[n][self._sampled] - back[n][self._sampled]) / (2 * step) for n in (0, 1)]
        valid, out = self._valid & np.isfinite(changes[1]), np.zeros((2, 3))
        for n, gradient in enumerate((self._normal, self._shade)):
            of_map, of_image = changes[n][valid], np.sum(gradient * motion, axis=-1)[valid]
            out[n] = np.sum(self._weights[n][valid] * (of_map**2, of_map * of_image, of_image**2), axis=1)
        return out


def _differences(image: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    across, down = np.zeros_like(image), np.zeros_like(image)
    across[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    down[1:-1] = (image[2:] - image[:-2]) / 2
    return across, down


def _complete(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    out = np.zeros_like(known)
    out[1:-1, 1:-1] = known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1]
    return out
