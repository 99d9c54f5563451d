"""Maps of rendered places from their true poses: what a perfect run would save."""

from dataclasses import dataclass, replace

import numpy as np

from dudmap.config import Config
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.place_recognition import KeyframeDatabase
from dudmap.core.places.saved_map import SavedMap
from dudmap.core.tracking.quality_monitor import RegistrationHistory
from dudmap.lab.synthetic.recording import SyntheticSequence
from dudmap.lab.synthetic.scene import Scene
from dudmap.lab.synthetic.setup import sequence

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
SMALL_THING = 2.0
"""Longest edge of furniture; larger boxes are walls, floors and ceilings, metres."""


@dataclass(frozen=True, eq=False)
class TrueMap:
    """A saved map, and the true pose (4, 4) of its world frame in the scene."""

    saved: SavedMap
    T_scene_world: np.ndarray

    def T_world_other(self, other: "TrueMap") -> np.ndarray:
        """True relative pose."""
        return se3.inverse(self.T_scene_world) @ other.T_scene_world


def true_map(recording: SyntheticSequence, voxel_size: float = 0.02, every: int = 3) -> TrueMap:
    """Map of every so many frames of a rendered recording from their true poses."""
    config = Config().override([f"volume.voxel_size={voxel_size}", "relocalization.keyframe_gap=0"])
    volume = TsdfVolume(recording.camera, config.volume, config.sensor, config.preprocess.depth_max)
    keyframes = KeyframeDatabase(config.relocalization, recording.camera, config.sensor)
    preprocess = Preprocessor(recording.camera, config.preprocess)
    poses = recording.ground_truth.Ts_world_camera
    for index in range(0, len(recording), every):
        T, frame = se3.inverse(poses[0]) @ poses[index], recording[index]
        volume.integrate(frame, T)
        keyframes.add(preprocess(frame), T)
    return TrueMap(SavedMap(volume, keyframes.keyframes, RegistrationHistory()), poses[0])


def record(scene: str, seed: int, path: str = "pan", frames: int = 90, change=None) -> SyntheticSequence:
    """A static recording of a scene, whose solids ``change`` may replace, its pose kept in the scene's frame."""
    recording = sequence(scene, (), frames=frames, seed=seed, camera=CAMERA, camera_path=path)
    if change is None:
        return recording
    changed = change(recording.scene)
    return SyntheticSequence(changed, [], recording.ground_truth, CAMERA, noise="kinect", seed=seed, fps=30.0)


def looking_elsewhere(scene: Scene) -> Scene:
    """The same place with nothing in common: all that stands in it is turned about the vertical by 180 degrees."""
    around = se3.exp(np.array([0, 0, 0, 0, 0, np.pi]))
    return replace(scene, primitives=[p.moved(around) for p in scene.primitives])


def retextured(scene: Scene, seed: int = 1, walls: bool = True) -> Scene:
    """A look-alike: the same shape everywhere, other textures and tints of all (or only of the small) things."""
    rng = np.random.default_rng([seed, 5])
    out = []
    for primitive in scene.primitives:
        offset, tint = rng.uniform(0, 1, 2), rng.uniform(0.6, 1.4, 3)
        if walls or 2 * max(primitive.bounds()) <= SMALL_THING:
            material = primitive.material
            tinted = tuple(np.array(material.tint) * tint)
            primitive = replace(primitive, material=replace(material, offset=tuple(offset), tint=tinted))
        out.append(primitive)
    return replace(scene, primitives=out)


def rearranged(scene: Scene, seed: int = 1, every: int = 1) -> Scene:
    """A look-alike: the same walls with the same textures, and every so many of the small things elsewhere."""
    rng = np.random.default_rng([seed, 6])
    out = []
    for number, primitive in enumerate(scene.primitives):
        T = np.eye(4)
        T[:2, 3] = rng.uniform(-0.7, 0.7, 2)
        small = 2 * max(primitive.bounds()) <= SMALL_THING
        out.append(primitive.moved(T) if small and number % every == 0 else primitive)
    return replace(scene, primitives=out)
