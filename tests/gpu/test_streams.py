"""Streams, events, pinned buffers and graphs: the results are those of the CPU device whatever is done first."""

import inspect
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.gpu.device import make_backend

wp = pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
make_backend("warp-cpu")

from streamed import NAME, Gpu, Launch, ScopedCapture, Stream
from test_images import FILTER

from dudmap.config import Config
from dudmap.gpu import backend as backends
from dudmap.gpu import faults, sequence
from dudmap.gpu.backend import WarpBackend
from dudmap.gpu.memory import Images
from dudmap.gpu.staging import KINDS, ImagePool, Staging
from dudmap.gpu.streams import CaptureGate, HostQueue, StreamQueue, main_queue, own_queue
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.tracker import Tracker
from small_maps import CAMERA, CONFIG

SEEDS = range(4)
TRACKER = Tracker(Config().override(["tracker.widths=[80,160]", "tracker.iterations=[5,4]"]).tracker, Config().sensor)


@pytest.fixture
def streamed(monkeypatch):
    """Makes a GPU, of which all memory is its own."""

    def make(seed):
        monkeypatch.setattr(backends, "_IMAGES", {})
        return Gpu(monkeypatch, seed)

    yield make
    sequence._refusing.clear()


def prepared(backend, frame):
    """Depth and intensity of a frame, and of its half."""
    depth = backend.filter(frame.depth.astype(np.float32), FILTER)
    shade = backend.intensity(np.ascontiguousarray(frame.color))
    small = backend.halve(depth, shade, 0.02)
    return SimpleNamespace(levels=[small, (depth, shade)], color=np.ascontiguousarray(frame.color))


def at_once(function, *arguments):
    """What a thread would do later, as a future."""
    result = function(*arguments)
    return SimpleNamespace(result=lambda: result)


def processed(device, recording, submit=at_once):
    """Everything that a small run computes; each frame is prepared before the one before it is registered and fused."""
    preparing, volume = WarpBackend(device), TsdfVolume(CAMERA, CONFIG, depth_max=6.0, backend=WarpBackend(device))
    found, following = [], submit(prepared, preparing, recording[0])
    for index in range(4):
        view, following = following.result(), submit(prepared, preparing, recording[index + 1])
        T = recording.ground_truth.Ts_world_camera[index]
        if index:
            levels = [
                SimpleNamespace(camera=CAMERA.scaled(n), depth=depth, intensity=shade)
                for n, (depth, shade) in zip((1, 0), view.levels, strict=True)
            ]
            for shift in (0.0, 0.004, -0.003):  # the map grows with each frame, so that the steps are prepared anew
                T_init = T.copy()
                T_init[:3, 3] += shift
                result = TRACKER.align(volume, levels, T_init)
                found += [result.T_world_camera, result.residual, result.color_residual, result.iterations]
        volume.integrate(SimpleNamespace(depth=view.levels[1][0], color=view.color), T)
        found += [image.copy() for level in view.levels for image in level]
        del view
    mesh, slots = volume.extract_mesh(1), volume.active_slots
    parts = volume.extract_chunks(slots, slots.astype(np.int64) % 5 - 1, 1)
    chunks = [array for part in parts for array in (part.vertices, part.faces)]
    index = [array.copy() for array in volume.blocks.arrays(volume.window.near)]
    voxels = volume.window.cells, volume.blocks.geometry.copy()
    return [*found, *index, *voxels, mesh.vertices, mesh.colors, *chunks, volume.raycast(T).depth]


@pytest.fixture(scope="module")
def expected(recording):
    return processed("cpu", recording)


def same(found, expected):
    return len(found) == len(expected) and all(
        np.array_equal(a, b, equal_nan=True) for a, b in zip(found, expected, strict=True)
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_the_order_of_the_streams_changes_no_result(streamed, recording, expected, seed):
    gpu = streamed(seed)
    found = processed(NAME, recording)
    assert same(found, expected)
    assert gpu.launched > 4  # the registrations are graphs


@pytest.mark.parametrize("seed", SEEDS)
def test_another_thread_may_prepare(streamed, recording, expected, seed):
    """The thread has the context of the device, and its images are ready for the main stream."""
    streamed(seed)
    with ThreadPoolExecutor(1) as reader:
        assert same(processed(NAME, recording, reader.submit), expected)


def tiles_of_an_image_that_is_gone(device, recording):
    """The main queue may still have to read an image when that has gone and others are prepared."""
    preparing, backend = WarpBackend(device), WarpBackend(device)
    depth = preparing.filter(recording[0].depth.astype(np.float32), FILTER)
    T = np.eye(4, dtype=np.float32)[:3]
    farthest = backend.view(depth, CAMERA.intrinsics, T, T).tiles.farthest
    del depth
    for index in (1, 2):  # the images that have gone make room for these
        preparing.filter(recording[index].depth.astype(np.float32) / 2, FILTER)
    return main_queue(device).download(farthest)


def test_an_image_is_overwritten_after_all_work_on_it(streamed, recording):
    expected = tiles_of_an_image_that_is_gone("cpu", recording)
    for seed in SEEDS:
        streamed(seed)
        np.testing.assert_array_equal(tiles_of_an_image_that_is_gone(NAME, recording), expected)


def test_an_image_that_is_overwritten_too_early_is_found_out(streamed, recording, monkeypatch):
    """The GPU of these tests is one on which mistakes show."""
    expected = tiles_of_an_image_that_is_gone("cpu", recording)
    monkeypatch.setattr(StreamQueue, "wait", lambda self, event: None)
    found = []
    for seed in SEEDS:
        streamed(seed)
        found.append(tiles_of_an_image_that_is_gone(NAME, recording))
    assert not all(np.array_equal(tiles, expected) for tiles in found)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_buffer_is_filled_again_when_it_was_read(streamed, seed):
    gpu = streamed(seed)
    queue = own_queue(NAME)
    staging, targets = Staging(queue), [gpu.warp.empty((3, 4), dtype=wp.float32, device=NAME) for _ in range(7)]
    for number, target in enumerate(targets):
        staging.upload(np.full((3, 4), number, np.float32), target)
    assert [staging.download(target)[0, 0] for target in targets] == [*range(7)]


@pytest.mark.parametrize("seed", SEEDS)
def test_several_arrays_are_downloaded_at_once(streamed, seed):
    warp = streamed(seed).warp
    staging = Staging(own_queue(NAME))
    kinds = ((3, 4), wp.float32), ((3, 4), wp.uint8), ((3, 4), wp.float32)
    targets = [warp.empty(shape, dtype=kind, device=NAME) for shape, kind in kinds]
    for turn in range(3):
        for number, target in enumerate(targets):
            kind = np.uint8 if number == 1 else np.float32
            staging.upload(np.full((3, 4), 10 * turn + number, kind), target)
        found = staging.download_all(targets)
        assert [array[1, 1] for array in found] == [10 * turn, 10 * turn + 1, 10 * turn + 2]
    with pytest.raises(ValueError, match="more than 2 arrays of one kind"):
        staging.download_all([targets[0]] * 3)


@pytest.mark.parametrize("device", ["cpu", NAME])
def test_few_kinds_of_images_have_buffers(streamed, device):
    """The memory of buffers that are given up may be used again when their copies are done."""
    warp = streamed(0).warp if device == NAME else wp
    staging, targets = Staging(main_queue(device)), []
    for size in [*range(1, 41), 1, 40]:
        targets.append(warp.empty(size, dtype=wp.float32, device=device))
        staging.upload(np.full(size, size, np.float32), targets[-1])
        assert len(staging._rings) <= KINDS
    for target in targets:
        np.testing.assert_array_equal(main_queue(device).download(target), len(target))


def test_a_buffer_that_is_filled_too_early_is_found_out(streamed, monkeypatch):
    monkeypatch.setattr(StreamQueue, "finish", lambda self, event: None)
    gpu = streamed(0)
    queue = own_queue(NAME)
    staging, targets = Staging(queue), [gpu.warp.empty((3, 4), dtype=wp.float32, device=NAME) for _ in range(7)]
    for number, target in enumerate(targets):
        staging.upload(np.full((3, 4), number, np.float32), target)
    gpu.synchronize_device()
    assert [target.numpy()[0, 0] for target in targets] != [*range(7)]


@pytest.mark.parametrize("device", ["cpu", NAME])
def test_images_that_are_gone_make_room_for_others(streamed, device):
    if device == NAME:
        streamed(0)
    images, pool = Images(device), ImagePool(own_queue(device), main_queue(device))
    first, host = pool.take((3, 4)), np.zeros((3, 4), np.float32)
    images.remember(host, first, pool.give_back)
    assert images.twin(host) is first
    assert pool.take((3, 4)) is not first
    del host
    assert pool.take((4, 3)) is not first
    assert pool.take((3, 4)) is first
    assert pool.take((3, 4)) is not first


def test_an_upload_of_the_main_queue_is_not_taken_by_another_one(streamed):
    streamed(0)
    images, array, staging = Images(NAME), np.zeros((3, 4), np.float32), Staging(main_queue(NAME))
    array.flags.writeable = False
    assert images.up(array, staging) is images.up(array, staging)
    assert images.twin(array) is None


def test_a_device_that_captures_no_graph_launches_one_by_one(streamed, recording, expected):
    gpu, told = streamed(1), []
    gpu.refusal = "Graph capture is not supported"
    with faults.told_to(told.append):
        assert same(processed(NAME, recording), expected)
    assert gpu.launched == 0
    assert len(told) == 1
    assert told[0].startswith("cuda:0 captures no graph (Graph capture is not supported)")
    assert not faults.is_lost(NAME)


def test_a_graph_of_the_cpu_device_gives_the_same(recording, expected, monkeypatch):
    """Warp records and replays there, too."""
    made = []

    def init(self, queue, commands, as_graph=None):
        original(self, queue, commands, True)
        made.append(self)

    original = sequence.Sequence.__init__
    monkeypatch.setattr(sequence.Sequence, "__init__", init)
    assert same(processed("cpu", recording), expected)
    assert made
    assert all(one.is_graph for one in made)


def test_a_frame_is_prepared_after_a_graph_was_captured(streamed, recording):
    streamed(0)
    preparing, queue, rgb = WarpBackend(NAME), main_queue(NAME), np.ascontiguousarray(recording[0].color)
    thread, waits = threading.Thread(target=preparing.intensity, args=(rgb,)), []

    class Command:
        def launch(self, stream):
            if stream is not queue.stream:  # the capture
                thread.start()
                thread.join(0.1)
                waits.append(thread.is_alive())

    steps = sequence.Sequence(queue, [Command()])
    steps.run()
    steps.prepare()
    thread.join(10)
    assert waits == [True]
    assert steps.is_graph
    assert not thread.is_alive()


def test_nothing_is_captured_while_another_thread_uses_the_device():
    gate, entered, leave, waited = CaptureGate(), threading.Event(), threading.Event(), []

    def use():
        with gate.use():
            entered.set()
            leave.wait(10)

    thread = threading.Thread(target=use)
    thread.start()
    assert entered.wait(10)
    with gate.use(), gate.capture() as alone:  # its own use does not count
        assert not alone
    leave.set()
    thread.join()
    with gate.capture() as alone:
        assert alone
        late = threading.Thread(target=lambda: (gate.use().__enter__(), waited.append(True)))
        late.start()
        late.join(0.05)
        assert not waited
    late.join(10)
    assert waited == [True]


@pytest.mark.parametrize(
    ("kind", "real", "names"),
    [
        (Stream, wp.Stream, ["record_event", "wait_event"]),
        (Launch, wp.Launch, ["launch", "set_param_by_name"]),
        (ScopedCapture, wp.ScopedCapture, ["__enter__", "__exit__"]),
    ],
)
def test_methods_of_the_simulated_gpu_are_those_of_warp(kind, real, names):
    for name in names:
        own, expected = (list(inspect.signature(getattr(one, name)).parameters) for one in (kind, real))
        assert own == expected or name == "__exit__"


def test_both_queues_have_every_operation():
    for kind in (HostQueue, StreamQueue):
        for name in ("launch", "repeat", "copy", "record", "wait", "finish", "captured", "replay", "download"):
            assert callable(getattr(kind, name))
