"""Analytic worlds with moving things: exact depth, colour, poses, masks and surface.

Importing this package is cheap; the renderer is loaded when a sequence is made.
"""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dudmap.camera import Camera
    from dudmap.synthetic.recording import SyntheticSequence

__all__ = ["sequence"]


def sequence(
    scene: str = "room",
    movers: tuple[str, ...] = ("person",),
    camera_path: "str | Path" = "handheld",
    frames: int = 120,
    fps: float = 30.0,
    noise: str = "kinect",
    speed: float | None = None,
    start_dynamic: bool = False,
    seed: int = 0,
    camera: "Camera | None" = None,
    motion_blur: float = 0.0,
    exposure_change: float = 0.0,
) -> "SyntheticSequence":
    """Make a synthetic recording; frames are rendered when they are asked for.

    Args:
        scene: Name of a world.
        movers: Names of the things that move; empty for none.
        camera_path: Name of a built-in path, or a trajectory file in TUM format.
        frames: Number of frames.
        fps: Frames per second.
        noise: Sensor: ``kinect``, ``realsense`` or ``none`` (exact depth).
        speed: Speed of the movers in m/s; None takes what is natural for each.
        start_dynamic: Whether the movers are in view from the first frame on.
        seed: Chooses path, looks and noise; the same seed gives the same frames.
        camera: Intrinsics; None for 640x480 with 525 px focal length.
        motion_blur: Share of the frame interval during which the shutter is open.
        exposure_change: Relative amplitude of a slow change of brightness.

    Raises:
        ConfigError: An argument is not acceptable; the message names the known values.
    """
    from dudmap.synthetic.recording import make_sequence

    return make_sequence(
        scene,
        movers,
        camera_path,
        frames,
        fps,
        noise,
        speed,
        start_dynamic,
        seed,
        camera,
        motion_blur,
        exposure_change,
    )
