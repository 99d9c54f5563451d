"""Pairs of visits drawn at random, and how well their changes are found."""

from pathlib import Path
from typing import Any

import numpy as np

from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.errors import ConfigError
from dudmap.lab.synthetic.recording import SyntheticSequence
from dudmap.lab.synthetic.visits import TrueChange, visits

SCENES = {"room": 0.5, "corridor": 0.2, "desk": 0.3}
THINGS = {"box": 0.35, "bin": 0.15, "ball": 0.1, "chair": 0.15, "shelf": 0.08, "poster": 0.1, "door": 0.07}
LARGE = ("chair", "shelf", "door")
"""Things that do not fit on a desk."""
KINDS = {"moved": 0.45, "appeared": 0.275, "disappeared": 0.275}
PATHS = ("handheld", "pan", "orbit", "dolly")
NONE, PEOPLE, LIGHT = 0.2, 0.2, 0.3
"""Shares of the pairs without any change, with people in the second visit, and with other light."""
FRAMES, FPS, SIZE = 60, 12.0, (320, 240)


def draw_pair(seed: int, number: int, changed: bool | None = None) -> dict[str, Any]:
    """Arguments of ``visits`` of pair ``number`` of a seed; ``changed`` decides whether there is any change."""
    rng = np.random.default_rng([seed, number, 33])

    def one_of(shares: dict[str, float]) -> str:
        return str(rng.choice(list(shares), p=np.array(list(shares.values())) / sum(shares.values())))

    scene, none = one_of(SCENES), rng.random() < NONE
    changes = []
    for _ in range(int(rng.integers(1, 5))):
        thing, kind = one_of(THINGS), one_of(KINDS)
        while scene == "desk" and thing in LARGE:
            thing = one_of(THINGS)
        changes.append((thing, {"poster": "recoloured", "door": "opened"}.get(thing, kind)))
    return {
        "changes": changes if (not none if changed is None else changed) else [],
        "scene": scene, "seed": int(rng.integers(1, 100_000)), "paths": tuple(str(x) for x in rng.choice(PATHS, 2)),
        "people": bool(rng.random() < PEOPLE), "other_light": bool(rng.random() < LIGHT),
        "frames": FRAMES, "fps": FPS, "camera": SIZE,
    }  # fmt: skip


def rendered_pair(pair: dict[str, Any]) -> tuple[list[SyntheticSequence], list[TrueChange]]:
    """Recordings and true changes of a pair; things that find no free place are left out."""
    while True:
        try:
            return visits(**pair)
        except ConfigError:
            if not pair["changes"]:
                raise
            pair = pair | {"changes": pair["changes"][:-1]}


def run_pair(recordings: list[SyntheticSequence], config: Config, out: Path) -> list[Path]:
    """Run folders of both visits."""
    folders = [out / "before", out / "after"]
    for recording, folder in zip(recordings, folders, strict=True):
        run(recording, config, folder, progress=False)
    return folders
