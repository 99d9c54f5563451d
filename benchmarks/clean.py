"""Recordings without their people against their true static twins.

python benchmarks/clean.py [--data FOLDER] [--with-person RECORDING] [--work FOLDER] [--passes N] [--only TEXT]
    [--pictures FOLDER] [--out FILE.json]

Synthetic worlds are rendered with and without movers; of the recordings under --data those count that have a static
twin (NAME_confusao and NAME_static); into a recording --with-person, of a place where nothing moves, a rendered person
is put who walks before the camera. Each is run with its own labels, then cleaned as `dudmap clean` does. Scored are
the pixels that show something that moves (true mask) and whose background another frame of the recording shows, judged
by true poses and the depth of the twin: the share that was filled, PSNR of the colour (dB), and RMSE and median of the
depth error (mm). For comparison the same of the recording as it is.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from dudmap.app.pipeline.run import run
from dudmap.app.views.cleaning import Cleaner
from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.io.exporting.run_content import RunContent
from dudmap.io.sequences import open_sequence
from dudmap.lab import synthetic

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240, depth_scale=5000.0)
WORLDS = {
    "person": {"scene": "room", "movers": ["person"], "frames": 120, "seed": 1},
    "people from the start": {"scene": "desk", "movers": ["people"], "frames": 120, "start_dynamic": True, "seed": 2},
    "pan, people": {"scene": "corridor", "movers": ["people"], "camera_path": "pan", "frames": 120, "seed": 3},
}
"""Synthetic recordings at 320x240 with the noise of a Kinect."""
SCORED, LOOKED_AT = 8, 5
"""Every so many frames are scored; every so many are asked whether they show the background."""
TOLERANCE = 0.03
"""A surface is the same if its depths agree within this share."""


class WithPerson:
    """A recording of a place where nothing moves, with a rendered person who walks before its camera.

    Args:
        sequence: The recording.
        frames: Number of frames, taken evenly.
    """

    calibration = None

    def __init__(self, sequence, frames=120):
        self._sequence = sequence
        self._chosen = np.linspace(0, len(sequence) - 1, min(frames, len(sequence))).astype(int)
        self.name, self.camera, self.format = f"{sequence.name} with a person", sequence.camera, sequence.format
        self.timestamps, self.ground_truth = sequence.timestamps[self._chosen], sequence.ground_truth
        straight = replace(sequence.camera, distortion=())
        self._person = synthetic.sequence(
            "room", movers=["person"], camera_path="still", frames=len(self._chosen), camera=straight, seed=1
        )

    def __len__(self):
        return len(self._chosen)

    def twin_frame(self, index):
        """The frame as it was recorded."""
        return self._sequence[int(self._chosen[index])]

    def mask(self, index):
        """Pixels that show the person."""
        depth, behind = self._person[index].depth, self.twin_frame(index).depth
        return self._person.mask(index) & (depth > 0) & ((behind == 0) | (depth < behind))

    def __getitem__(self, index):
        frame, person, mask = self.twin_frame(index), self._person[index], self.mask(index)
        return replace(
            frame,
            depth=np.where(mask, person.depth, frame.depth).astype(np.float32),
            color=np.where(mask[..., None], person.color, frame.color),
        )


class Chosen:
    """The frames of a recording that ``WithPerson`` takes."""

    def __init__(self, sequence):
        self._sequence = sequence

    def __getitem__(self, index):
        return self._sequence.twin_frame(index)


def pairs(data: Path | None, with_person: list[Path], frames: int):
    """Name, recording and static twin."""
    for folder in with_person:
        sequence = WithPerson(open_sequence(folder), frames)
        yield sequence.name, sequence, Chosen(sequence)
    for name, arguments in WORLDS.items():
        sequence = synthetic.sequence(camera=CAMERA, **arguments)
        yield name, sequence, sequence.static_twin()
    for folder in sorted(data.glob("*_confusao")) if data else []:
        twin = folder.with_name(folder.name.replace("_confusao", "_static"))
        if twin.is_dir():
            yield folder.name, open_sequence(folder), open_sequence(twin)


def true_poses(sequence):
    """True poses of the frames that have one within 20 ms, by number."""
    truth = sequence.ground_truth
    gaps = [float(np.abs(truth.timestamps - stamp).min()) for stamp in sequence.timestamps]
    inside = (sequence.timestamps >= truth.timestamps[0]) & (sequence.timestamps <= truth.timestamps[-1])
    return {
        index: truth.interpolate(float(stamp))
        for index, stamp in enumerate(sequence.timestamps)
        if gaps[index] < 0.02 and inside[index]
    }


def static_views(sequence, twin, poses):
    """Pose and static depth, 0 where something moves, of every so many frames."""
    return [(poses[index], np.where(sequence.mask(index), 0, twin[index].depth)) for index in list(poses)[::LOOKED_AT]]


def seen_elsewhere(index, sequence, twin, poses, views):
    """Pixels (H, W) of a frame that show something that moves and whose background another frame shows."""
    camera = replace(sequence.camera, distortion=())
    mask, depth = sequence.mask(index), twin[index].depth
    rows, columns = np.nonzero(mask & (depth > 0))
    points = camera.points(columns, rows, depth[rows, columns].astype(float))
    points = points @ poses[index][:3, :3].T + poses[index][:3, 3]
    seen = np.zeros(len(points), bool)
    for T_world_camera, depth in views:
        T = se3.inverse(T_world_camera)
        p = points @ T[:3, :3].T + T[:3, 3]
        u, v = np.rint(np.nan_to_num(camera.project(p), nan=-1)).T.astype(int)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        there = depth[v[inside], u[inside]]
        seen[inside] |= np.abs(there - p[inside, 2]) < TOLERANCE * p[inside, 2]
    out = np.zeros(mask.shape, bool)
    out[rows[seen], columns[seen]] = True
    return out


def figures(color, depth, twin_frame, used, filled):
    """PSNR and depth errors over pixels (H, W)."""
    both = used & filled
    error = (color.astype(float) - twin_frame.color)[both]
    differences = 1000 * (depth - twin_frame.depth)[both & (depth > 0) & (twin_frame.depth > 0)]
    return float((error**2).sum()), error.size, differences, int(both.sum()), int(used.sum())


def combined(parts):
    """One line of the table from the parts of all frames."""
    squares, count = sum(part[0] for part in parts), sum(part[1] for part in parts)
    depth = np.concatenate([part[2] for part in parts])
    return {
        "filled": round(sum(part[3] for part in parts) / max(sum(part[4] for part in parts), 1), 4),
        "psnr_db": round(float(10 * np.log10(255**2 * count / squares)), 2),
        "depth_rmse_mm": round(float(np.sqrt(np.mean(depth**2))), 1),
        "depth_median_mm": round(float(np.median(np.abs(depth))), 1),
    }


def score(name, sequence, twin, work: Path, passes: int, pictures: Path | None):
    """Rows of one recording: cleaned, and as it is."""
    folder = work / name.replace(" ", "_").replace(",", "")
    if not (folder / "map.npz").is_file():
        config = Config()
        run(sequence, config, folder, save_masks=True, progress=False, passes=passes, calibrate=True)
    cleaner = Cleaner(RunContent.load(folder), sequence)
    poses = true_poses(sequence)
    views = static_views(sequence, twin, poses)
    cleaned, as_is = [], []
    for index in cleaner.indices[::SCORED]:
        if index not in poses:
            continue
        used = seen_elsewhere(index, sequence, twin, poses, views)
        background = cleaner.clean(index)
        frame, moving = background.frame, background.moving
        truth = twin[index]
        missed = used & ~moving
        color = np.where(missed[..., None], frame.color, background.color)
        filled = missed | (background.known & (background.depth > 0))
        cleaned.append(figures(color, background.depth, truth, used, filled))
        as_is.append(figures(frame.color, frame.depth, truth, used, np.ones_like(used)))
        if pictures is not None:
            save_picture(pictures / f"{folder.name}-{index:04d}.png", frame, background, truth, moving)
    row = {"recording": name, "frames": len(cleaner.indices), **combined(cleaned)}
    return row | {f"as_it_is_{key}": value for key, value in combined(as_is).items() if key != "filled"}


def save_picture(path, frame, background, truth, moving):
    """As recorded, cleaned, the truth; below the depths, and what was replaced."""
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)

    def shown(depth):
        return cv2.applyColorMap(np.clip(depth * 40, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO)

    colors = [image[..., ::-1] for image in (frame.color, background.color, truth.color)]
    depths = [shown(depth) for depth in (frame.depth, background.depth, truth.depth)]
    unknown = np.where((moving & ~background.known)[..., None], np.array([0, 0, 255]), moving[..., None] * 255)
    colors.append(unknown.astype(np.uint8))
    depths.append(np.zeros_like(depths[0]))
    cv2.imwrite(str(path), np.vstack([np.hstack(colors), np.hstack(depths)]))


def main():
    """Print one line for each recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with recordings NAME_confusao and NAME_static")
    parser.add_argument("--with-person", type=Path, action="append", default=[], help="static recording; repeatable")
    parser.add_argument("--frames", type=int, default=120, help="of the recordings --with-person, taken evenly")
    parser.add_argument("--work", type=Path, help="keeps the run folders here, and uses those that are here already")
    parser.add_argument("--only", help="only the recordings whose name holds this")
    parser.add_argument("--passes", type=int, default=2)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        for name, sequence, twin in pairs(arguments.data, arguments.with_person, arguments.frames):
            if arguments.only is None or arguments.only in name:
                rows.append(score(name, sequence, twin, work, arguments.passes, arguments.pictures))
                print(json.dumps(rows[-1]), flush=True)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
