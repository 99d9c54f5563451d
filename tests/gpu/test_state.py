"""Checkpoints and runs are the same on the device and on the CPU, and can be continued on the other one."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")

from dudmap import resume_system, save_system
from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.storing import Storing
from dudmap.cli import app
from dudmap.config import Config
from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.warp.backend import WarpBackend
from dudmap.core.slam import Slam
from dudmap.lab import synthetic
from dudmap.lab.synthetic.folder import write_folder
from small_maps import CAMERA, voxels
from state_differences import differences

SAVED_AFTER, FRAMES = 4, 7
KIND = {"cpu": CpuBackend, "warp-cpu": WarpBackend}


@pytest.fixture(scope="module")
def frames():
    recording = synthetic.sequence(frames=FRAMES, camera=CAMERA)
    return [recording[index] for index in range(FRAMES)]


@pytest.fixture(scope="module", params=["cpu", "warp-cpu"])
def saved(request, frames, tmp_path_factory):
    """A device, a system that ran on it to the end, its poses, and the file it was saved to on the way."""
    path = tmp_path_factory.mktemp("state") / "slam.db"
    slam = Slam(CAMERA, Config().override([f"device={request.param}", "volume.voxel_size=0.03"]))
    for number, frame in enumerate(frames):
        if number == SAVED_AFTER:
            save_system(slam, path)
        slam.process(frame)
    return request.param, slam, path


@pytest.mark.parametrize("device", ["cpu", "warp-cpu"])
def test_a_system_is_continued_on_either_device(saved, frames, device):
    """On the same device bit for bit, on the other within the tolerance of a registration."""
    written_on, whole, path = saved
    slam = resume_system(path, device)
    kind = KIND[device]
    assert type(slam.volume.backend) is kind
    for frame in frames[SAVED_AFTER:]:
        assert slam.process(frame).status == "tracked"
    poses, others = (one.trajectory.Ts_world_camera for one in (whole, slam))
    assert np.array_equal(poses[:SAVED_AFTER], others[:SAVED_AFTER])
    if device != written_on:
        assert np.linalg.norm((poses - others)[:, :3, 3], axis=1).max() < 3e-3
        return
    assert np.array_equal(poses, others)
    expected, found = voxels(whole.volume), voxels(slam.volume)
    assert expected.keys() == found.keys()
    assert all(np.array_equal(a, b) for key in expected for a, b in zip(expected[key], found[key], strict=True))


def test_the_state_of_a_device_is_that_of_the_cpu(saved):
    """Restored on both devices, one state gives the same tree, voxels and frames, bit for bit."""
    _, _, path = saved
    both = [resume_system(path, device) for device in KIND]
    found = differences(*both)
    assert [line for line in found if not ("device" in line or line.endswith("config"))] == []


class Interrupt(RunObserver):
    def frame(self, index, read, result, ms):
        if index == SAVED_AFTER:
            raise KeyboardInterrupt


@pytest.mark.parametrize(("first", "second"), [("warp-cpu", "cpu"), ("cpu", "warp-cpu")])
def test_a_run_is_continued_on_the_other_device(first, second, tmp_path):
    from dudmap.io.sequences import open_sequence

    sequence = synthetic.sequence("room", frames=FRAMES, camera=CAMERA, noise="kinect")
    recording = write_folder(sequence, tmp_path / "room", surface=False)
    config = Config().override(["sensor.self_calibration=false", "volume.voxel_size=0.03", f"device={first}"])
    storing = Storing({"path": str(recording), "camera": None, "topics": None}, 0.0)
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run(open_sequence(recording), config, out, progress=False, observers=(Interrupt(),), storing=storing)
    done = CliRunner().invoke(app, ["run", "--resume", str(out), "--device", second, "--json"])
    metrics = json.loads(done.stdout)
    assert metrics["complete"]
    assert metrics["tracked"] == FRAMES
    assert Config.load(out / "config.toml").device == second
