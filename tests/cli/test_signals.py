"""SIGTERM and SIGHUP end the program as Ctrl-C does: results are written, recordings can be read."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from dudmap.io.sequences import open_sequence

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Windows has no such signals")
DUDMAP = [sys.executable, "-c", "from dudmap.cli import main; main()"]
FAST = ["--set", "volume.voxel_size=0.04"]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    place = tmp_path_factory.mktemp("room") / "room"
    command = [*DUDMAP, "synth", place, "--max-frames", "300", "--size", "96x72"]
    subprocess.run(command, check=True, capture_output=True)
    return place


def started(*arguments, wait_for, **options):
    """The program, as soon as it has written something to a file or folder."""
    process = subprocess.Popen([*DUDMAP, *map(str, arguments)], stderr=subprocess.PIPE, text=True, **options)
    deadline = time.monotonic() + 240
    while not (wait_for.exists() and wait_for.stat().st_size) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return process


def live_recording(room, folder, wait):
    """A live run that records, ``wait`` seconds after its first recorded frame."""
    settings = *FAST, "--set", "sensor.self_calibration=false"
    command = "live", f"replay:{room}", "--out", folder / "out", "--record", folder / "walk.mcap", *settings
    process = started(*command, wait_for=folder / "walk.recording" / "walk.recording.mcap")
    time.sleep(wait)
    return process


def check_run_folder(out, said):
    for name in ("trajectory.txt", "mesh.ply", "map.npz", "report.html", "metrics.json"):
        assert (out / name).stat().st_size > 0, (name, said)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["tracked"] >= 1, said
    assert metrics["complete"]
    return metrics


def end_live(room, folder, wait):
    """Send SIGTERM to a live run and check its results."""
    process = live_recording(room, folder, wait)
    process.terminate()
    _, said = process.communicate(timeout=240)
    assert process.returncode == 143, said
    assert "defect" not in said
    if "no frame of the camera" not in said:
        check_run_folder(folder / "out", said)
    if "recorded 0 frames" in said:
        return
    full, found = open_sequence(room), open_sequence(folder / "walk.mcap")
    assert not found.remarks
    first = int(np.argmin(abs(full.timestamps - found.timestamps[0])))
    np.testing.assert_array_equal(found[0].color, full[first].color)


def kill_live(room, folder, wait):
    """Kill a live run and check its recording."""
    begin = time.monotonic()
    process = live_recording(room, folder, wait)
    process.kill()
    process.communicate()
    file = folder / "walk.recording" / "walk.recording.mcap"
    found = open_sequence(file)
    assert "not closed" in found.remarks[0]
    full = open_sequence(room)
    for index in range(len(found)):
        np.testing.assert_array_equal(found[index].color, full[index_of(full, found.timestamps[index])].color)
    recorded = found.timestamps[-1] - found.timestamps[0]
    assert wait - 1.5 <= recorded <= time.monotonic() - begin  # the first byte was written up to half a second late


def index_of(full, stamp):
    return int(np.argmin(abs(full.timestamps - stamp)))


def test_sigterm_ends_a_live_run_with_its_results_and_its_recording(room, tmp_path):
    end_live(room, tmp_path, 2.0)


def test_a_recording_is_readable_up_to_the_last_second_when_its_process_is_killed(room, tmp_path):
    kill_live(room, tmp_path, 3.0)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(20))
def test_sigterm_at_random_moments(room, tmp_path, number):
    end_live(room, tmp_path, np.random.default_rng([52, number]).uniform(0, 12))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(10))
def test_killed_at_random_moments(room, tmp_path, number):
    kill_live(room, tmp_path, np.random.default_rng([53, number]).uniform(1, 8))


def test_a_closed_terminal_ends_a_run_which_can_be_resumed(room, tmp_path):
    """SIGHUP comes twice, of the kernel and of the shell, and all that is printed then fails."""
    out, (ours, theirs) = tmp_path / "out", os.openpty()
    command = ["run", str(room), "--out", str(out), "--calibration", "given", "--max-frames", "150", *FAST]
    process = subprocess.Popen([*DUDMAP, *command], stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    while not list((out / "thumbnails").glob("*")):
        assert process.poll() is None
        time.sleep(0.05)
    os.close(ours)
    for _ in range(2):
        process.send_signal(signal.SIGHUP)
    assert process.wait(timeout=240) == 129
    frames = json.loads((out / "metrics.json").read_text())["frames"]
    assert 0 < frames < 150
    assert (out / "mesh.ply").is_file()
    subprocess.run([*DUDMAP, "run", "--resume", out], check=True, capture_output=True)
    assert json.loads((out / "metrics.json").read_text())["frames"] == 150


def test_sigterm_ends_a_run_and_names_how_to_go_on(room, tmp_path):
    out = tmp_path / "out"
    command = "run", room, "--out", out, "--calibration", "given", *FAST
    process = started(*command, wait_for=out / "thumbnails")
    while not list((out / "thumbnails").glob("*")) and process.poll() is None:
        time.sleep(0.05)
    process.terminate()
    _, said = process.communicate(timeout=240)
    assert process.returncode == 143, said
    assert f"dudmap run --resume {out} goes on" in said
    assert json.loads((out / "metrics.json").read_text())["frames"] > 0


PROGRAM = """
import select, signal, sys
from dudmap import interruption
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what runs in the background
interruption.listen()
try:
    with interruption.postponed():
        print("ready", flush=True)
        taken = False
        while not select.select([sys.stdin], [], [], 0.02)[0]:
            if not taken and interruption._Request.signal:
                taken = True
                print("taken", flush=True)
        print("written", flush=True)
except KeyboardInterrupt:
    print("asked", interruption.name(), flush=True)
sys.exit(interruption.exit_code(0))
"""


def program(*signals, pause=0.0, completes=True):
    """Exit code and output of a program that is sent signals while it writes, which it completes or never does."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-c", PROGRAM], **pipes)
    limit = threading.Timer(60, process.kill)
    limit.start()
    assert process.stdout.readline() == "ready\n"
    for n, number in enumerate(signals):
        process.send_signal(number)
        if n == 0 and pause:
            assert process.stdout.readline() == "taken\n"
            time.sleep(pause)
    if completes:
        time.sleep(0.3)
        process.stdin.write("go on\n")
        process.stdin.flush()
    said = process.stdout.read()
    process.stdin.close()
    process.stdout.close()
    limit.cancel()
    return process.wait(timeout=60), [line for line in said.splitlines() if line != "taken"]


def test_what_is_written_is_completed():
    assert program() == (0, ["written"])
    assert program(signal.SIGTERM, pause=0.01) == (143, ["written", "asked SIGTERM"])
    assert program(signal.SIGHUP, pause=0.01) == (129, ["written", "asked SIGHUP"])
    assert program(signal.SIGINT, pause=0.01) == (0, ["written", "asked Ctrl-C"])


def test_a_second_signal_ends_at_once_unless_it_is_the_echo_of_the_first():
    assert program(signal.SIGTERM, signal.SIGTERM, pause=1.5, completes=False) == (-signal.SIGTERM, [])
    assert program(signal.SIGTERM, signal.SIGINT, pause=1.5, completes=False) == (143, ["asked SIGTERM"])
    assert program(signal.SIGTERM, signal.SIGTERM) == (143, ["written", "asked SIGTERM"])  # as timeout sends them
    assert program(signal.SIGTERM, signal.SIGHUP, pause=1.2) == (143, ["written", "asked SIGTERM"])


def test_what_is_ignored_stays_ignored():
    """As by nohup."""
    command = f"import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n{PROGRAM}"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-c", command], **pipes)
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGHUP)
    assert process.communicate("go on\n", timeout=60)[0] == "written\n"
    assert process.returncode == 0


def test_a_program_that_uses_the_library_keeps_its_handlers(slam, tmp_path):
    from dudmap import Config, run
    from recordings import write_recording

    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    run(open_sequence(write_recording(tmp_path / "desk", 3)), Config(), tmp_path / "out", progress=False)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before


def test_a_request_that_numba_turns_into_an_error_of_its_own_is_recognised():
    from dudmap import interruption

    def kernel():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as interrupt:
            raise SystemError("returned a result with an exception set") from interrupt

    with pytest.raises(KeyboardInterrupt), interruption.recognised():
        kernel()
    with pytest.raises(SystemError), interruption.recognised():
        raise SystemError("another one")
