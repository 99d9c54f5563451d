"""Analytic worlds with moving things: exact depth, colour, poses, masks and surface.

Importing this package is cheap; the renderer is loaded when a sequence is made.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from dudmap.camera import Camera
    from dudmap.synthetic.recording import SyntheticSequence

__all__ = ["names", "sequence"]


def sequence(
    scene: str = "room",
    movers: "Sequence[str] | None" = None,
    camera_path: "str | Path | None" = None,
    frames: int = 120,
    fps: float = 30.0,
    noise: str = "kinect",
    speed: float | None = None,
    coverage: float | None = None,
    start_dynamic: bool = False,
    situation: str | None = None,
    seed: int = 0,
    camera: "Camera | None" = None,
    motion_blur: float = 0.0,
    exposure_change: float = 0.0,
) -> "SyntheticSequence":
    """Make a synthetic recording; frames are rendered when they are asked for.

    Args:
        scene: Name of a world (``names()["scenes"]``).
        movers: Names of the things that move, () for none; None for one person, or what the situation needs.
        camera_path: Name of a built-in path, or a trajectory file in TUM format; None for hand-held, or the
            situation's.
        frames: Number of frames.
        fps: Frames per second.
        noise: Sensor: ``kinect``, ``realsense`` or ``none`` (exact depth).
        speed: Speed of the movers in m/s; None takes what is natural for each.
        coverage: Share of the image, 0 to 0.95, that a stream of people hides on average; it replaces the movers,
            0 means nobody.
        start_dynamic: Whether the movers are in view from the first frame on.
        situation: Name of a difficult situation (``names()["situations"]``).
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
        coverage,
        start_dynamic,
        situation,
        seed,
        camera,
        motion_blur,
        exposure_change,
    )


def names() -> dict[str, list[str]]:
    """Known names of scenes, movers, camera paths, situations and noise models."""
    from dudmap.synthetic.movers import MOVERS
    from dudmap.synthetic.paths import FOLLOW, PATHS
    from dudmap.synthetic.rooms import SCENES
    from dudmap.synthetic.sensors import SENSORS
    from dudmap.synthetic.situations import SITUATIONS

    return {
        "scenes": list(SCENES),
        "movers": list(MOVERS),
        "camera_paths": [*PATHS, FOLLOW],
        "situations": list(SITUATIONS),
        "noise": list(SENSORS),
    }
