"""Runs in processes that are killed at chosen moments, and what remains of them."""

import contextlib
import hashlib
import json
import os
import signal
import threading
import time
import traceback
from pathlib import Path

import cv2
import numpy as np

from delayed_color import FAULTS
from dudmap.app.pipeline.resume import resume
from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.run_folder import LOCK
from dudmap.app.pipeline.storing import Storing
from dudmap.app.state.database import StateDatabase
from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.frame_store import FrameStore
from dudmap.errors import StateError
from dudmap.lab import synthetic
from dudmap.lab.synthetic.recording import SyntheticSequence
from rendered import Rendered

SMALL = Camera(fx=157.52, fy=157.52, cx=95.5, cy=71.5, width=192, height=144)
CONFIG = Config().override(
    [
        "volume.voxel_size=0.025",
        "submaps.patience=0.3",
        "loops.min_age=1.0",
        "loops.gap=3",
    ]
)
EVERY = 0.3
"""Seconds from one checkpoint to the next."""
TIMES = (
    "ms_per_frame_median", "ms_per_frame_p95", "ms_reading_median", "wall_s", "cpu_s", "peak_rss_mb", "command", "date",
)  # fmt: skip
"""Metrics that differ between two processes."""


def lost_and_found():
    """A room, a jump to another part of it that begins a second map, and the way back, which joins the maps; the colour
    is taken after the depth."""
    yaw = np.concatenate([np.zeros(6), np.full(9, -80.0), -78 * np.cos(np.linspace(0, np.pi / 2, 22)), np.zeros(10)])
    base = synthetic.sequence(movers=(), frames=len(yaw), seed=1, camera=SMALL, camera_path="slow", fps=15.0,
                              noise="realsense")  # fmt: skip
    Ts, up = base.ground_truth.Ts_world_camera.copy(), base.scene.home[:3, 1]
    for T, angle in zip(Ts, np.radians(yaw), strict=True):
        T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), angle * up]))[:3, :3] @ T[:3, :3]
    moved = Trajectory(base.timestamps, Ts)
    recording = Rendered(SyntheticSequence(base.scene, [], moved, SMALL, noise="realsense", seed=1, fps=15.0,
                                           faults=FAULTS))  # fmt: skip
    recording.mask = lambda index: None
    for index in range(len(recording)):  # before processes are forked
        recording[index]
    return recording


def begin(sequence, out, every=EVERY, **options):
    """The run whose processes are killed."""
    return run(sequence, CONFIG, out, save_masks=True, progress=False, storing=Storing({}, every), **options)


def proceed(sequence, out):
    """What ``dudmap run --resume`` does; a run that was killed before it had a folder is begun."""
    try:
        return resume(out, sequence, progress=False)
    except StateError as error:
        if "holds no state" in str(error) or "ended before its first frame" in str(error):
            return begin(sequence, out)
        raise


def results(out):
    """Checksums of all files of a run but for times, and its metrics without them.

    The lock file is no result: a process killed between its last result and its end leaves one, which locks nothing.
    """
    files = {str(path.relative_to(out)): path for path in sorted(out.rglob("*")) if path.is_file()}
    sums = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()
            if name not in ("metrics.json", "timings.csv", LOCK)}  # fmt: skip
    metrics = json.loads((out / "metrics.json").read_text())
    return sums | {key: value for key, value in metrics.items() if key not in TIMES}


def in_child(function, *arguments):
    """Exit status of a function in a process of its own: -9 if it was killed, 0 if it came to its end."""
    process = os.fork()
    if process == 0:
        code = 1
        try:
            cv2.setNumThreads(1)
            with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
                function(*arguments)
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    _, status = os.waitpid(process, 0)
    return os.waitstatus_to_exitcode(status)


def die():
    """End this process as a power cut or the kernel's memory killer would."""
    os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60)


def after(calls, function):
    """The function, which ends the process after so many calls."""
    left = iter(range(calls))

    def counted(*arguments, **options):
        value = function(*arguments, **options)
        if next(left, None) is None:
            die()
        return value

    return counted


def killed(sequence, out, moment, rng, duration, statements, go=begin):
    """Run and be killed at a random moment of a kind; an undisturbed run takes so many seconds and statements."""
    if moment == "anywhere":
        timer = threading.Timer(rng.uniform(0, 0.9 * duration), die)
        timer.daemon = True
        timer.start()
    elif moment == "checkpoint":  # between two statements of a transaction
        StateDatabase._execute = after(int(rng.integers(4, 0.6 * statements)), StateDatabase._execute)
    elif moment == "join":  # a map is half rebuilt from stored frames
        Atlas.join = after(0, Atlas.join)
        FrameStore.__getitem__ = after(int(rng.integers(0, 3)), FrameStore.__getitem__)
    elif moment == "export":  # between two result files
        keep, count = Path.replace, int(rng.integers(0, 7))
        counted = after(count, keep)

        def replace(path, target):
            return keep(path, target) if path.suffix == ".png" else counted(path, target)

        Path.replace = replace
    go(sequence, out)
