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
"""Standard deviation of the intensity of a voxel: one grey level, in which voxels store it."""
SAMPLES_ACROSS, MIN_SAMPLES = 40, 10
"""Readings across the image from which the noise of H is computed, and how many of all must lie on the map."""
INTERPOLATED = 2 * (2 / 3) ** 2
"""Variance of a component of the gradient of the trilinear interpolation of independent values of variance 1, per cell:
a difference of two means over four edges, each of whose weights a (1 - a) squares to (2/3)^2 over the cell."""
STEEPEST = 9.5
"""Tangent of the angle of incidence, 84 degrees, beyond which sensors give no reading."""
REGULAR = 1e-6
"""Share by which the diagonal of the noise is raised."""
AXES = "sideways", "up and down", "forwards", "nodding", "turning", "rolling"
"""Motion along and about the camera's x, y and z."""


@dataclass(frozen=True, eq=False)
class Observability:
    """Which directions of a twist (v, omega) about the camera's centre a registration determines.

    Attributes:
        observable: (6, m) basis of the determined directions, world axes.
        unobservable: (6 - m, 6) the others, camera axes; each of unit length if one radian counts as the mean depth.
    """

    observable: NDArray[np.float64]
    unobservable: NDArray[np.float64]

    @property
    def is_complete(self) -> bool:
        """Whether every direction is determined."""
        return len(self.unobservable) == 0

    def with_shown(self, shown: NDArray[np.bool_], R_world_camera: NDArray[np.float64]) -> "Observability":
        """The same with those of the k unobservable directions that are ``shown`` (k,) among the observable ones."""
        if shown.all():
            return COMPLETE
        more = np.kron(np.eye(2), R_world_camera) @ self.unobservable[shown].T
        return Observability(np.hstack([self.observable, more]), self.unobservable[~shown])


COMPLETE = Observability(np.eye(6), np.empty((0, 6)))
"""Every direction is determined."""


@dataclass(frozen=True, eq=False)
class GradientNoise:
    """Information that noise of the gradients alone contributes to H.

    Attributes:
        distances, intensities: (6, 6) of the two terms, world axes.
        variances: Mean variances of the gradients of the two terms.
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
        """Directions on which the information of both terms, each in units of its own noise, exceeds it.

        Gradients e + n of a term with noise n give E[H] = H_true + N: where a view says nothing, H is not zero but N,
        and the registration settles wherever the noise fits best. A term of precise gradients and one of poor ones
        count by their variances s^2: the generalised eigenvalues of

            (H_d / s_d^2 + H_c / s_c^2) v = mu (N_d / s_d^2 + N_c / s_c^2) v

        are 1 where there is only noise, whatever the units of translation and rotation.

        Args:
            H_distances: (6, 6) normal equations of the distances alone, world axes.
            H: (6, 6) of both terms.
            R_world_camera: (3, 3).
            least: Smallest eigenvalue of a direction that is determined.
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
    """Generalised eigenvalues (6,) of ``H v = mu noise v``, ascending, and eigenvectors in the columns of (6, 6)."""
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
    """What noise of the gradients contributes to H in a view.

    Noise of standard deviation sigma per pixel of size a, smoothed by a Gaussian of width s, has the gradient variance
    sigma^2 a^2 / (8 pi s^4) (variance sigma^2 a^2 / (4 pi s^2) over 2 s^2); s is that of the filter and of half a voxel
    together. A voxel takes the reading of the nearest pixel, which on a slanted surface is wrong by a uniform share of
    the step g between two pixels, in each voxel by another: the trilinear interpolation of distances of variance
    g^2 / 12 has the gradient variance 2 (2/3)^2 g^2 / 12 / voxel^2. Intensities of neighbouring voxels are independent:
    2 (2/3)^2 sigma_I^2 / voxel^2. The noise is isotropic, so that a reading at p from the camera's centre contributes
    its variance times J' J with J = [I, -hat(p)].

    Args:
        level: The image.
        residuals: (2, h, w) of the linearisation, NaN off the map.
        weights: (h, w) static weights.
        R_world_camera: (3, 3).
        voxel_size: Metres.
        map_width: Width of the images that the map was made of, pixels.
        filter_px: Spatial standard deviation of their depth filter, pixels.
        parameters: The weights of the residuals.
        H: (6, 6) normal equations of both terms, world axes.
        least: Smallest information of a direction that is determined, in units of the noise.

    Returns:
        None where H has more than ``least`` times the information of the noise on every direction (then one of its two
        terms has), without enough readings on the map, or where the pixels of the map's images are wider than its
        voxels: then neighbouring voxels take the same reading, and the noise is another one.
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
    """Reason why a pose is uncertain: the directions (k, 6) that a view does not determine, empty if there are none."""
    if len(unobservable) == 0:
        return ""
    strongest = np.abs(unobservable).max(axis=0)
    named = [name for name, share in zip(AXES, strongest, strict=True) if share > 0.5 * strongest.max()]
    return f"the view does not show how the camera moves in {len(unobservable)} direction(s): {', '.join(named)}"


ACROSS = 80
"""Readings across the image whose gradients are compared."""
MIN_AGREEMENT = 0.2
"""Share of the gradients, of distances and intensities together, that map and image have in common, from which on a
direction is shown. Noise gives 1 / sqrt(n) in n readings, 0.02; an endless tunnel and a wall without texture gave up to
0.06, walls with wallpaper of which H says no more than of those two 0.3 to 0.6 (rendered
corridors)."""


class GradientAgreement:
    """Compares the gradients of a linearisation with those of its image.

    Noise of the map's gradients adds to H, and nothing in H tells it from what the scene shows. The image has gradients
    of its own, whose noise is independent of the map's: the sum of products of the two is without that bias. It is an
    instrumental variable, as errors in the variables of a regression ask for (Fuller 1987, Measurement error models,
    section 1.4). This holds for the intensities alone: errors of the distances are not independent, since the depth
    filter rounds the corners of a tunnel the more the farther they are, in every image alike, so that the tunnel seems
    to narrow, and to move with the camera.

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
