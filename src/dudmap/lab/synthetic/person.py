"""Articulated model of a walking person made of capsules, ellipsoids and boxes."""

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.synthetic.scene import Material, Primitive, box, capsule, ellipsoid, pose

HIP, KNEE, SHOULDER, ELBOW = 0.90, 0.44, 1.40, 0.28  # hip and shoulder above the ground, thigh and upper arm lengths
SHANK = 0.40
TORSO, HEAD, ARM_L, ARM_R, FOREARM_L, FOREARM_R, THIGH_L, THIGH_R, SHANK_L, SHANK_R = range(10)

OUTFITS = (
    ("stripes", (1.0, 1.0, 1.0), (0.45, 0.55, 0.85)),
    ("plaid", (1.0, 0.85, 0.8), (0.75, 0.68, 0.55)),
    ("checks", (0.6, 0.9, 0.7), (0.4, 0.4, 0.45)),
    ("wallpaper", (1.1, 0.75, 0.6), (0.5, 0.6, 0.5)),
    ("denim", (1.2, 0.6, 0.55), (0.35, 0.4, 0.6)),
)


class Figure:
    """Person 1.72 m tall times ``size``, facing +x and standing on z = 0.

    Attributes:
        primitives: The solids, each in the frame of its limb.
        limbs: (P,) number of the limb of each solid.
    """

    def __init__(self, rng: np.random.Generator, outfit: int, size: float = 1.0, stride: float = 1.35) -> None:
        pattern, shirt_tint, trouser_tint = OUTFITS[outfit % len(OUTFITS)]
        shift = tuple(rng.random(2))
        shirt = Material(pattern, (1.7 / size, 1.7 / size), shift, shirt_tint)
        trousers = Material("denim", (1.5 / size, 1.5 / size), shift, trouser_tint)
        skin = Material("skin", (3.0 / size, 3.0 / size), shift)
        hair = Material("denim", (3.0 / size, 3.0 / size), shift, (0.35, 0.25, 0.18))
        shoe = Material("denim", (2.0 / size, 2.0 / size), shift, (0.25, 0.22, 0.22))
        self.size, self.stride = size, stride * size
        parts: list[tuple[int, Primitive]] = [
            (TORSO, ellipsoid((0, 0, HIP + 0.04), (0.115, 0.165, 0.13), trousers)),
            (TORSO, ellipsoid((0, 0, HIP + 0.33), (0.125, 0.185, 0.27), shirt)),
            (TORSO, capsule((0, -0.13, SHOULDER - 0.01), (0, 0.13, SHOULDER - 0.01), 0.075, shirt)),
            (TORSO, capsule((0, 0, SHOULDER), (0.01, 0, SHOULDER + 0.12), 0.05, skin)),
            (HEAD, ellipsoid((0.02, 0, SHOULDER + 0.21), (0.095, 0.075, 0.115), skin)),
            (HEAD, ellipsoid((-0.005, 0, SHOULDER + 0.24), (0.10, 0.082, 0.10), hair)),
            (HEAD, ellipsoid((0.115, 0, SHOULDER + 0.20), (0.02, 0.014, 0.022), skin)),
        ]
        for arm, forearm in ((ARM_L, FOREARM_L), (ARM_R, FOREARM_R)):
            parts += [
                (arm, capsule((0, 0, 0), (0, 0, -ELBOW), 0.046, shirt)),
                (forearm, capsule((0, 0, 0), (0, 0, -0.23), 0.036, skin)),
                (forearm, ellipsoid((0, 0, -0.31), (0.03, 0.022, 0.075), skin)),
            ]
        for thigh, shank in ((THIGH_L, SHANK_L), (THIGH_R, SHANK_R)):
            parts += [
                (thigh, capsule((0, 0, 0), (0, 0, -KNEE), 0.075, trousers)),
                (shank, capsule((0, 0, 0), (0, 0, -SHANK), 0.052, trousers)),
                (shank, box((0.06, 0, -SHANK - 0.025), (0.25, 0.09, 0.07), shoe)),
            ]
        scale = np.diag([size, size, size, 1.0])
        self.limbs = np.array([limb for limb, _ in parts])
        self.primitives = [_scaled(primitive, scale, size) for _, primitive in parts]

    def poses(self, T_world_person: NDArray[np.float64], walked: float, carrying: float = 0.0) -> NDArray[np.float64]:
        """Pose T_world_limb (P, 4, 4) of every solid after ``walked`` metres; ``carrying`` in [0, 1] lifts the arms."""
        phase = 2 * np.pi * walked / self.stride
        swing = np.degrees(np.arcsin(min(self.stride / self.size / 4 / (KNEE + SHANK), 0.6)))
        limbs = np.tile(np.eye(4), (10, 1, 1))
        lean = pose(pitch=3.0) @ pose(yaw=4.0 * np.sin(phase))
        lowest = []
        for side, thigh, shank in ((1, THIGH_L, SHANK_L), (-1, THIGH_R, SHANK_R)):
            angle = side * swing * np.sin(phase)
            knee = 6.0 + 42.0 * (swing / 24.0) * max(side * np.cos(phase), 0.0) ** 2
            limbs[thigh] = pose((0, side * 0.085, HIP), pitch=-angle)
            limbs[shank] = limbs[thigh] @ pose((0, 0, -KNEE), pitch=knee)
            foot = limbs[shank] @ np.array([[-0.065, 0.185], [0, 0], [-SHANK - 0.06, -SHANK - 0.06], [1, 1]])
            lowest.append(foot[2].min())
        for side, arm, forearm in ((1, ARM_L, FOREARM_L), (-1, ARM_R, FOREARM_R)):
            angle = (1 - carrying) * (-side * 0.9 * swing * np.sin(phase)) + carrying * 25.0
            bend = (1 - carrying) * 22.0 + carrying * 65.0
            limbs[arm] = lean @ pose((0, side * 0.215, SHOULDER - 0.02), pitch=-angle, roll=side * 6.0 * (1 - carrying))
            limbs[forearm] = limbs[arm] @ pose((0, 0, -ELBOW), pitch=-bend)
        limbs[TORSO] = lean
        limbs[HEAD] = pose(yaw=2.0 * np.sin(phase)) @ lean
        limbs[:, 2, 3] -= min(lowest)  # the lower foot stands on the ground
        limbs[:, :3, 3] *= self.size
        return (T_world_person @ limbs)[self.limbs]


def _scaled(primitive: Primitive, scale: NDArray[np.float64], size: float) -> Primitive:
    T = primitive.T_body_primitive.copy()
    T[:3, 3] = (scale @ np.append(T[:3, 3], 1.0))[:3]
    hx, hy, hz = primitive.half
    return Primitive(primitive.kind, (hx * size, hy * size, hz * size), T, primitive.material)
