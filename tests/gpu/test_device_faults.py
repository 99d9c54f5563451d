"""A device that fails in the middle of a run: the CPU goes on, nothing that was computed is lost, and it is said."""

import re

import numpy as np
import pytest

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")

from failing import FULL, LOST, Device
from test_map import linearized

from dudmap import synthetic
from dudmap.config import Config
from dudmap.geometry import se3
from dudmap.gpu import fallback, faults, memory
from dudmap.gpu.device import make_backend, start_failure
from dudmap.gpu.faults import DeviceWarning
from dudmap.kernels.backend import OPERATIONS
from dudmap.kernels.cpu import CpuBackend
from dudmap.mapping.volume import TsdfVolume
from dudmap.pipeline.observer import RunObserver
from dudmap.pipeline.run import run
from dudmap.pipeline.storing import Storing
from dudmap.slam import Slam
from small_maps import CAMERA, integrated, voxels
from wavy_wall import CAMERA as WALL_CAMERA
from wavy_wall import CONSTANT, wall

SETTINGS = Config().override(["volume.voxel_size=0.03", "sensor.self_calibration=false"])


@pytest.fixture
def device(monkeypatch):
    yield Device(monkeypatch)
    faults.forget()


@pytest.fixture
def told():
    """Sentences that are told instead of warned of."""
    sentences = []
    with faults.told_to(sentences.append):
        yield sentences


def add(volume, recording, *indices):
    for index in indices:
        volume.integrate(recording[index], recording.ground_truth.Ts_world_camera[index])


def elsewhere(volume, recording):
    """The volume with two frames at a place where it has no blocks yet."""
    for index in (2, 3):
        T = recording.ground_truth.Ts_world_camera[index].copy()
        T[:3, 3] += 1.0
        volume.integrate(recording[index], T)
    return volume


def apart(trajectory, other):
    """Largest distance between the cameras of two trajectories, metres."""
    return np.linalg.norm((trajectory.Ts_world_camera - other.Ts_world_camera)[:, :3, 3], axis=1).max()


def weights(volume):
    return {key: (words >> 8) & 0xFF for key, (words, _) in voxels(volume).items()}


def test_the_fallback_has_every_operation():
    assert [name for name in OPERATIONS if not callable(getattr(fallback.FallbackBackend, name, None))] == []


def test_a_lost_device_leaves_the_map_as_the_host_has_it(recording, device, told):
    volume = integrated(recording, "warp-cpu", frames=4)  # after which the host takes over the voxels
    before = weights(volume)
    add(volume, recording, 4)
    device.breaks()
    add(volume, recording, 5)
    assert len(told) == 2
    assert told[0] == f"cpu failed ({LOST}); the run goes on on the CPU"
    assert "lacks what cpu had written" in told[1]
    after = weights(volume)
    common = before.keys() & after.keys()
    assert len(common) > 0.9 * len(before)
    assert np.mean([after[key].sum() > before[key].sum() for key in common]) > 0.8  # by the last frame
    assert volume.raycast(recording.ground_truth.Ts_world_camera[5]).depth.any()
    assert len(volume.extract_mesh(1).faces) > 5000
    assert isinstance(make_backend("warp-cpu"), CpuBackend)


def test_python_warns_where_nobody_listens(recording, device):
    volume = integrated(recording, "warp-cpu", frames=1)
    device.breaks()
    with pytest.warns(DeviceWarning) as caught:
        add(volume, recording, 1, 2)
    assert [str(warning.message).startswith("cpu failed") for warning in caught] == [True]


def test_the_map_is_brought_to_the_host_now_and_then(recording, device, told, monkeypatch):
    monkeypatch.setattr(fallback, "KEPT_EVERY", 2)
    volume = integrated(recording, "warp-cpu", frames=4)
    device.breaks()
    found = weights(volume)
    assert "lacks" not in " ".join(told)
    device.works()
    faults.forget()
    expected = weights(integrated(recording, "warp-cpu", frames=4))
    assert found.keys() == expected.keys()
    assert all(np.array_equal(found[key], words) for key, words in expected.items())


@pytest.mark.parametrize("kernel", ["mark_cells", "visible_slots", "pack_pixels", "observe_free", "integrate"])
def test_a_frame_is_fused_once_where_memory_runs_out(recording, device, told, kernel):
    """Whatever step fails, the map is that of the CPU but for roundings, and the device is used again afterwards."""
    expected = weights(integrated(recording, "cpu"))
    volume = integrated(recording, "warp-cpu", frames=2)
    device.breaks(FULL, kernel)
    add(volume, recording, 2)
    device.works()
    launched = len(device.launched)
    add(volume, recording, 3)
    found = weights(volume)
    assert found.keys() == expected.keys()
    different = np.mean([found[key] != words for key, words in expected.items()])
    assert different < 1e-3
    assert kernel in device.launched[launched:]
    assert len(told) == 1
    assert "too little free memory for the operation" in told[0]


def test_a_mesh_that_does_not_fit_is_made_on_the_cpu(maps, recording, device, told):
    volume = integrated(recording, "warp-cpu")
    device.breaks(FULL, "write_vertices")
    found = volume.extract_mesh(1)
    device.works()
    np.testing.assert_array_equal(found.faces, volume.extract_mesh(1).faces)
    assert "extract_mesh, which is done on the CPU" in told[0]


def test_a_map_that_does_not_fit_goes_on_on_the_cpu(recording, monkeypatch, told):
    """What the device had written is kept, and the sentence says how large a voxel would fit."""
    reference, volume = integrated(recording, "cpu", frames=2), integrated(recording, "warp-cpu", frames=2)
    expected = weights(elsewhere(reference, recording))
    monkeypatch.setattr(memory, "free_memory", lambda device: 1000)
    elsewhere(volume, recording)
    assert volume.blocks.geometry_mirror.copy is None
    assert volume.blocks.colors_mirror.copy is None
    found = weights(volume)
    assert found.keys() == expected.keys()
    assert np.mean([found[key] != words for key, words in expected.items()]) < 1e-3
    assert len(told) == 2
    assert "those farthest from the camera wait on disk" in told[0]  # which is not enough
    assert "volume.voxel_size at least" in told[1]
    assert not faults.is_lost("cpu")


def test_a_map_grows_by_the_host_where_two_copies_do_not_fit(recording, monkeypatch):
    reference, volume = integrated(recording, "cpu", frames=2), integrated(recording, "warp-cpu", frames=2)
    expected = weights(elsewhere(reference, recording))
    linearized(volume, recording)
    copies = volume.blocks.geometry_mirror.copy, volume.blocks.colors_mirror.copy
    before = [len(copy.array) for copy in copies]
    assert copies[0].users  # recorded launches, which would keep the smaller array
    monkeypatch.setattr(memory, "has_room", lambda num_bytes, device: any(len(copy.array) == 0 for copy in copies))
    elsewhere(volume, recording)
    assert not copies[0].users
    assert all(len(copy.array) > rows for copy, rows in zip(copies, before, strict=True))
    found = weights(volume)
    assert np.mean([found[key] != words for key, words in expected.items()]) < 1e-3


def test_residuals_that_are_lost_with_the_device_are_computed_anew(maps, recording, device, told):
    volume = integrated(recording, "warp-cpu")
    _ = volume.blocks.geometry, volume.blocks.colors
    equations = linearized(volume, recording)
    kept = equations.residuals[0]
    device.breaks()
    for number, expected in enumerate(linearized(maps[0], recording).residuals):
        found = equations.residuals[number]
        assert (np.isnan(found) != np.isnan(expected)).mean() < 1e-3
    assert np.isfinite(kept).any()
    assert len(told) == 1


def test_single_voxels_are_read_from_the_host_after_a_loss(recording, device, told):
    volume = integrated(recording, "warp-cpu")
    depth, T = recording[3].depth.astype(np.float32), recording.ground_truth.Ts_world_camera[3]
    expected = volume.known_share(depth, CAMERA, T)
    _ = volume.blocks.geometry
    device.breaks()
    np.testing.assert_allclose(volume.known_share(depth, CAMERA, T), expected, atol=1e-6)


def test_a_device_is_tried_before_it_is_used(device):
    assert start_failure.__wrapped__("cpu") == ""
    device.breaks(FULL)
    assert start_failure.__wrapped__("cpu") == FULL


def test_errors_of_the_program_are_raised(recording, monkeypatch):
    import warp as wp

    volume = integrated(recording, "warp-cpu", frames=1)

    def wrong(*_, **__):
        raise TypeError("an argument has the wrong type")

    monkeypatch.setattr(wp, "launch", wrong)
    with pytest.raises(TypeError):
        add(volume, recording, 1)


def test_a_system_goes_on(recording, device, told):
    """The device is lost within a frame, when the host has the map of the first two: no frame is lost."""
    plain, slam = (Slam(CAMERA, SETTINGS.override([f"device={name}"])) for name in ("cpu", "warp-cpu"))
    for index in range(6):
        if index == 3:
            device.breaks(only="add_up")
        for system in (plain, slam):
            assert system.process(recording[index]).state == "tracked"
    assert "failed" in told[0]
    assert apart(slam.trajectory, plain.trajectory) < 0.01


class Breaks(RunObserver):
    """The device fails after a frame."""

    def __init__(self, device, number):
        self.device, self.number, self.seen = device, number, []

    def frame(self, index, read, result, ms):
        self.seen.append((index, result.state))
        if index == self.number:
            self.device.breaks()


def test_a_run_goes_on_from_its_last_checkpoint(device, tmp_path, capfd):
    """No frame is missing, none is there twice, and the poses are those of a system that is moved to the CPU there."""
    recording = synthetic.sequence(frames=10, camera=CAMERA, movers=())
    storing = Storing({"path": "", "camera": None, "topics": None}, 0.0)
    observer = Breaks(device, 6)
    config, out = SETTINGS.override(["device=warp-cpu"]), tmp_path / "run"
    report = run(recording, config, out, progress=False, observers=(observer,), storing=storing, ahead=0)
    assert report.metrics["complete"]
    assert len(report.trajectory) == report.metrics["frames"] == 10
    np.testing.assert_allclose(report.trajectory.timestamps, recording.timestamps[:10], atol=1e-6)
    numbers = [index for index, _ in observer.seen]
    again = numbers[numbers.index(7) + 1]
    assert again <= 7
    assert numbers[-1] == 9
    said = capfd.readouterr().err
    assert f"frames {again} to 7 are processed again, from the last checkpoint on" in said
    assert "cpu failed" in said
    device.works()
    faults.forget()
    slam = Slam(CAMERA, config)
    for index in range(10):
        if index == again:
            slam.save(tmp_path / "slam.db")
            slam = Slam.resume(tmp_path / "slam.db", "cpu")
        slam.process(recording[index])
    assert np.array_equal(report.trajectory.Ts_world_camera, slam.trajectory.Ts_world_camera)


def test_without_checkpoints_a_run_goes_on_with_the_map_of_the_host(device, tmp_path, capfd):
    recording = synthetic.sequence(frames=8, camera=CAMERA, movers=())
    config = SETTINGS.override(["device=warp-cpu"])
    observer = Breaks(device, 4)
    report = run(recording, config, tmp_path / "run", progress=False, observers=(observer,), ahead=0)
    assert report.metrics["complete"]
    assert [index for index, _ in observer.seen] == [*range(8)]
    assert "cpu failed" in capfd.readouterr().err


def test_the_farthest_blocks_leave_a_device_that_is_full(monkeypatch, told):
    """A long wall on a device for 2304 blocks: the map is that of the CPU, and the device is used to the end."""
    config = CONSTANT.model_copy(update={"min_weight": 1, "voxel_size": 0.02})
    whole, paged = (
        TsdfVolume(WALL_CAMERA, config, depth_max=3.0, backend=make_backend(name)) for name in ("cpu", "warp-cpu")
    )
    per_row = 2 * 512 * 4  # geometry and colours

    def free(device):
        blocks = paged._index.held
        copies = blocks.geometry_mirror.copy, blocks.colors_mirror.copy
        return 1.25 * 2304 * per_row - sum(copy.array.size * 4 for copy in copies if copy is not None)

    monkeypatch.setattr(memory, "free_memory", free)
    for number, x in enumerate((*np.arange(0.0, 21.0, 1.5), 18.0, 15.0)):
        for volume in (whole, paged):
            volume.integrate(wall(1.5, number), se3.exp(np.array([x, 0, 0, 0, 0.1 * (number % 4), 0])))
    assert len(told) == 1
    assert re.search(r"has room for 1[678]\d\d blocks of the map; those farthest from the camera wait", told[0])
    assert paged.blocks.geometry_mirror.copy is not None
    assert paged.num_blocks == whole.num_blocks > 3000
    assert paged.pager.num_blocks > 500
    expected, found = (
        {tuple(c): part.geometry[n] for part in volume.records() for n, c in enumerate(part.coords[part.owners])}
        for volume in (whole, paged)
    )
    assert found.keys() == expected.keys()
    assert np.mean([(found[key] >> 8 & 0xFF) != (words >> 8 & 0xFF) for key, words in expected.items()]) < 1e-3
