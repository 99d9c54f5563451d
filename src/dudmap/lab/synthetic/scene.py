"""Primitives, materials, lights and scenes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Vector = Sequence[float] | NDArray[np.float64]

BOX, ELLIPSOID, CAPSULE, CYLINDER, TORUS = range(5)  # as in kernels.raytracing


@dataclass(frozen=True)
class Material:
    """Appearance of a surface.

    Attributes:
        scale: Texture repeats per metre, across and down.
        offset: In repeats.
        tint: Factors on red, green, blue.
        variation: Relative amplitude of low-frequency brightness.
        glow: Emitted light (screens, lamps).
        faces: Whether faces of a box differ.
    """

    texture: str = "plain"
    scale: tuple[float, float] = (0.5, 0.5)
    offset: tuple[float, float] = (0.0, 0.0)
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    variation: float = 0.15
    glow: float = 0.0
    faces: bool = True

    def row(self) -> list[float]:
        """Parameters for the shading kernel (10 numbers)."""
        return [*self.scale, *self.offset, *self.tint, self.variation, self.glow, float(self.faces)]


@dataclass(frozen=True, eq=False)
class Primitive:
    """One solid in its body's frame; the world for static ones.

    Attributes:
        kind: BOX, ELLIPSOID, CAPSULE and CYLINDER (axis z), TORUS (around z).
        half: Half extents, metres: box hx hy hz; ellipsoid semi-axes; capsule and cylinder (radius, radius, half
            length); torus (ring radius, ring radius, tube radius).
        T_body_primitive: (4, 4).
    """

    kind: int
    half: tuple[float, float, float]
    T_body_primitive: Matrix
    material: Material

    def bounds(self) -> NDArray[np.float64]:
        """Half extents (3,) of the bounding box, own frame."""
        hx, hy, hz = self.half
        if self.kind == CAPSULE:
            return np.array([hx, hy, hz + hx])
        if self.kind == TORUS:
            return np.array([hx + hz, hx + hz, hz])
        return np.array([hx, hy, hz])

    def moved(self, T: Matrix) -> "Primitive":
        """Primitive after the rigid motion ``T`` (4, 4)."""
        return replace(self, T_body_primitive=T @ self.T_body_primitive)

    def scaled(self, size: float) -> "Primitive":
        """Primitive ``size`` times as large, with its texture."""
        T, (hx, hy, hz), (across, down) = self.T_body_primitive.copy(), self.half, self.material.scale
        T[:3, 3] *= size
        material = replace(self.material, scale=(across / size, down / size))
        return Primitive(self.kind, (hx * size, hy * size, hz * size), T, material)

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (N,) in metres of points (N, 3) in the body frame; negative inside.

        Exact but for the ellipsoid, to first order.
        """
        R, t = self.T_body_primitive[:3, :3], self.T_body_primitive[:3, 3]
        local = (points - t) @ R
        hx, _, hz = self.half
        if self.kind == BOX:
            excess = np.abs(local) - self.half
            return np.linalg.norm(np.maximum(excess, 0), axis=1) + np.minimum(excess.max(axis=1), 0)
        if self.kind == ELLIPSOID:
            scaled = np.linalg.norm(local / self.half, axis=1)
            slope = np.linalg.norm(local / np.square(self.half), axis=1)
            return scaled * (scaled - 1) / np.maximum(slope, 1e-12)
        if self.kind == CAPSULE:
            local[:, 2] -= np.clip(local[:, 2], -hz, hz)
            return np.linalg.norm(local, axis=1) - hx
        rho = np.hypot(local[:, 0], local[:, 1]) - hx
        if self.kind == TORUS:
            return np.hypot(rho, local[:, 2]) - hz
        excess = np.stack([rho, np.abs(local[:, 2]) - hz], axis=1)
        return np.linalg.norm(np.maximum(excess, 0), axis=1) + np.minimum(excess.max(axis=1), 0)


def pose(position: Vector = (0, 0, 0), yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Matrix:
    """Rigid motion (4, 4): ``position`` in metres; roll (x), pitch (y), yaw (z), degrees."""
    (ca, cb, cc), (sa, sb, sc) = (f(np.radians([yaw, pitch, roll])) for f in (np.cos, np.sin))
    T = np.eye(4)
    T[:3, :3] = (
        np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]])
        @ np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
        @ np.array([[1, 0, 0], [0, cc, -sc], [0, sc, cc]])
    )
    T[:3, 3] = position
    return T


def look_at(eye: Vector, target: Vector, roll: float = 0.0) -> Matrix:
    """T_world_camera (4, 4) at ``eye``, aimed at ``target``, z up, rolled by ``roll`` degrees."""
    forward = np.asarray(target, float) - np.asarray(eye, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    T[:3, :3] = T[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    T[:3, 3] = eye
    return T


def box(center: Vector, size: Vector, material: Material, yaw: float = 0.0, pitch: float = 0.0) -> Primitive:
    """Box of full extents ``size`` (3,) around ``center``."""
    x, y, z = (float(s) / 2 for s in size)
    return Primitive(BOX, (x, y, z), pose(center, yaw, pitch), material)


def ellipsoid(center: Vector, half: Vector, material: Material, yaw: float = 0.0) -> Primitive:
    """Ellipsoid with semi-axes ``half`` (3,)."""
    x, y, z = (float(s) for s in half)
    return Primitive(ELLIPSOID, (x, y, z), pose(center, yaw), material)


def _along(start: Vector, end: Vector) -> tuple[Matrix, float]:
    a, b = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(b - a))
    z = (b - a) / length
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = (a + b) / 2
    return T, length


def capsule(start: Vector, end: Vector, radius: float, material: Material) -> Primitive:
    """Capsule: all points within ``radius`` of the segment from ``start`` to ``end``."""
    T, length = _along(start, end)
    return Primitive(CAPSULE, (radius, radius, length / 2), T, material)


def cylinder(start: Vector, end: Vector, radius: float, material: Material) -> Primitive:
    """Closed cylinder between the centres of its two caps."""
    T, length = _along(start, end)
    return Primitive(CYLINDER, (radius, radius, length / 2), T, material)


def torus(center: Vector, axis: Vector, ring: float, tube: float, material: Material) -> Primitive:
    """Torus of ring radius ``ring`` around ``axis`` and tube radius ``tube``."""
    T, _ = _along(center, np.asarray(center, float) + np.asarray(axis, float))
    T[:3, 3] = center
    return Primitive(TORUS, (ring, ring, tube), T, material)


@dataclass(frozen=True)
class Light:
    """Light: position (world frame, metres), strength, fall-off per square metre.

    ``softness`` is the sine of the angle by which it reaches surfaces that face away from its centre; 0 for a point.
    """

    position: tuple[float, float, float]
    strength: float = 0.6
    falloff: float = 0.04
    softness: float = 0.5


@dataclass(frozen=True, eq=False)
class Scene:
    """Static scene with places for paths and movers; z up, floor z = 0.

    Attributes:
        primitives: World frame.
        space: ((3,), (3,)) box of the camera.
        extent: ((3,), (3,)) box of the reference surface.
        walk_line: Two floor points, along which walkers cross.
        rest: T_world_body (4, 4) of put-down boxes (bottom centre).
        hinge: Of a door at the floor; the leaf extends along +x and opens against +y.
        lights: Point lights.
        detail: Triangle edges of the reference surface, metres.
        mover_scale: Size of movers.
        ground: Height of standing movers, metres.
    """

    name: str
    primitives: list[Primitive]
    home: Matrix
    target: tuple[float, float, float]
    space: tuple[tuple[float, float, float], tuple[float, float, float]]
    extent: tuple[tuple[float, float, float], tuple[float, float, float]]
    walk_line: tuple[tuple[float, float], tuple[float, float]]
    rest: Matrix
    hinge: Matrix
    lights: tuple[Light, ...] = (Light((0.0, 0.0, 2.4)),)
    ambient: float = 0.45
    sky: tuple[float, float, float] = (0.0, 0.0, 0.0)
    detail: float = 0.02
    mover_scale: float = 1.0
    ground: float = 0.0

    def clearance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance (N,), metres, from points (N, 3) to the nearest solid; negative inside."""
        return np.min([p.distance(points) for p in self.primitives], axis=0)
