"""Runs of every kind that are interrupted in this process and continued from their folder."""

import json
from contextlib import closing

import cv2
import numpy as np
import pytest
from killing import results

from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.resume import resume
from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.storing import Storing
from dudmap.app.viewing.report import Thumbnails
from dudmap.config import Config
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.saved_map import SavedMap
from dudmap.lab import synthetic
from dudmap.lab.synthetic.folder import write_folder

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
FRAMES = 18


class Interrupt(RunObserver):
    """Ctrl-C after a frame of a pass."""

    def __init__(self, number, passes):
        self.number, self.passes = number, passes

    def start(self, slam, out, count):
        self.passes -= 1

    def frame(self, index, read, result, ms):
        if index == self.number and self.passes == 0:
            raise KeyboardInterrupt


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    sequence = synthetic.sequence("room", movers=("person",), frames=FRAMES, camera=SMALL, noise="kinect")
    return write_folder(sequence, tmp_path_factory.mktemp("recordings") / "room", surface=False)


def both(recording, tmp_path, passes=1, **options):
    """Results of a whole run, and of one that was interrupted in its last pass and continued."""
    from dudmap.io.sequences import open_sequence

    settings = Config().override(["sensor.self_calibration=false", "movers.meshes=true", "volume.voxel_size=0.02"])
    for name in ("whole", "parts"):
        out = tmp_path / name
        if "saved_map" in options:
            options["saved_map"] = SavedMap.load(tmp_path / "first", settings.volume.voxel_size)
        watching = (Thumbnails(), *([Interrupt(12, passes)] if name == "parts" else []))
        storing = Storing({"path": str(recording), "camera": None, "topics": None}, 0.1)
        arguments = {"progress": False, "save_masks": True, "passes": passes, "observers": watching, "storing": storing}
        try:
            run(open_sequence(recording), settings, out, **arguments, **options)
        except KeyboardInterrupt:
            assert not json.loads((out / "metrics.json").read_text())["complete"]
            assert 3 <= next_frame(out) <= 13
            resume(out, progress=False, observers=(Thumbnails(),))
    return results(tmp_path / "whole"), results(tmp_path / "parts")


def next_frame(out):
    from dudmap.app.state.database import StateReader

    with closing(StateReader(out / "state.db")) as reader:
        return reader.meta()["next"]


def test_one_pass_with_given_masks(recording, tmp_path):
    (tmp_path / "given").mkdir()
    mask = np.zeros(SMALL.shape, np.uint8)
    mask[:40, :30] = 255
    stamps = np.loadtxt(recording / "depth.txt", usecols=0)
    for stamp in stamps[::2]:
        cv2.imwrite(str(tmp_path / "given" / f"{stamp:.6f}.png"), mask)
    whole, parts = both(recording, tmp_path, masks=tmp_path / "given")
    assert whole == parts
    assert whole["frames_with_mask"] > 5
    assert any(name.startswith("thumbnails/") for name in whole)


@pytest.mark.slow
def test_two_passes(recording, tmp_path):
    whole, parts = both(recording, tmp_path, passes=2)
    assert whole == parts


@pytest.mark.parametrize("localize", [False, True])
def test_a_run_that_goes_on_in_a_saved_map(recording, tmp_path, localize):
    from dudmap.io.sequences import open_sequence

    run(open_sequence(recording), Config().override(["volume.voxel_size=0.02"]), tmp_path / "first", progress=False)
    whole, parts = both(recording, tmp_path, saved_map=None, localize=localize)
    assert whole == parts
    assert whole["tracked"] > 8
