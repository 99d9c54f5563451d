"""What looking at a run costs: the page of a million triangles, its export, and --view while a run goes on.

python benchmarks/viewing.py [--frames N] [--rounds N] [--out FILE.json]

Prints one line per figure with its target: seconds until the report of a map of a million triangles is drawn in a
Chromium without a graphics card (on the PATH, or DUDMAP_CHROMIUM), megabytes of the report, seconds of the GLB export
(reading the run folder included), and milliseconds per frame that --view takes of the thread of the run, 640x480: its
processor time, and the difference of the median time per frame with and without it, measured in turn (with a page that
is open where there is a browser). A figure whose library or browser is missing is left out with the reason.
"""

import argparse
import json
import socket
import statistics
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from browsers import SOFTWARE, find_chromium
from dudmap import Mesh, export_run
from dudmap.app.pipeline.run import run
from dudmap.app.viewing.report import write_report
from dudmap.config import Config
from dudmap.errors import MissingExtraError
from dudmap.lab import synthetic
from run_folders import write_run

SIDE = 708
"""Vertices along a side of the map: 2 * 707^2 = 999 698 triangles."""


def million():
    """A wavy floor 7 m wide with colours."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    vertices = np.stack([0.01 * (x - SIDE / 2), 0.3 * np.sin(x / 30) * np.cos(y / 40) + 1, 0.01 * y], -1)
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).reshape(-1)
    faces = np.concatenate([
        np.stack([corner, corner + 1, corner + SIDE], 1), np.stack([corner + 1, corner + SIDE + 1, corner + SIDE], 1)
    ])  # fmt: skip
    colors = np.random.default_rng(0).integers(60, 200, (SIDE * SIDE, 3), dtype=np.uint8)
    normals = np.tile(np.array([0, -1, 0], np.float32), (SIDE * SIDE, 1))
    return Mesh(vertices.reshape(-1, 3).astype(np.float32), faces.astype(np.int32), colors, normals)


@contextmanager
def chromium():
    """A browser, or None and why there is none."""
    program = find_chromium()
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        yield None, "playwright is not installed"
        return
    if program is None:
        yield None, "no Chromium on the PATH, and DUDMAP_CHROMIUM names none"
        return
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=SOFTWARE)
        yield browser, ""
        browser.close()


def page_seconds(browser, report, rounds):
    """Seconds until the page is drawn, the best of some rounds."""
    taken = []
    for _ in range(rounds):
        page = browser.new_page(viewport={"width": 1100, "height": 900})
        start = time.perf_counter()
        page.goto(report.as_uri())
        page.wait_for_selector("html[data-ready=true]", timeout=120000)
        taken.append(time.perf_counter() - start)
        page.close()
    return min(taken)


def view_ms(browser, frames, rounds):
    """Mean processor time of --view per frame in the thread of the run; median times per frame without and with it."""
    from dudmap.app.viewing.live_view import LiveView
    from dudmap.app.viewing.window import Window

    class Measured(LiveView):
        taken: list[float] = []  # noqa: RUF012 - of all rounds

        def frame(self, *arguments):
            start = time.thread_time()
            super().frame(*arguments)
            self.taken.append(1000 * (time.thread_time() - start))

    recording = synthetic.sequence("room", movers=("person",), frames=frames)
    medians = {False: [], True: []}
    for number in range(2 * rounds):
        watched = bool(number % 2)
        with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
            observers = ()
            if watched:
                with socket.socket() as free:
                    free.bind(("127.0.0.1", 0))
                    port = free.getsockname()[1]
                window = Window("127.0.0.1", port, "benchmark")
                stack.callback(window.stop)
                if browser is not None:
                    page = browser.new_page()
                    stack.callback(page.close)
                    page.goto(window.url)
                view = Measured(window)
                stack.callback(view.close)
                observers = (view,)
            done = run(recording, Config(), folder, progress=False, ahead=0, observers=observers)
            medians[watched].append(done.metrics["ms_per_frame_median"])
    return statistics.mean(Measured.taken), statistics.median(medians[False]), statistics.median(medians[True])


def main():
    """Print one line per figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60, help="of the runs with and without --view")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    figures = {}

    def note(name, value, unit, target=None):
        figures[name] = {"value": value, "unit": unit, "target": target}
        goal = "" if target is None else f", target {target:g}: {'reached' if value <= target else 'MISSED'}"
        print(f"{name}: {value:.2f} {unit}{goal}", flush=True)

    with tempfile.TemporaryDirectory() as temporary, chromium() as (browser, reason):
        folder, mesh = write_run(Path(temporary) / "run"), million()
        mesh.save(folder / "mesh.ply")
        start = time.perf_counter()
        report = write_report(folder)
        note("write the report of 1 M triangles", time.perf_counter() - start, "s")
        note("size of the report", report.stat().st_size / 1e6, "MB", 15)
        if browser is not None:
            note("load the report", page_seconds(browser, report, arguments.rounds), "s", 3)
        else:
            print(f"load the report: left out, {reason}")
        export_run(folder, Path(temporary) / "warm.glb")
        start, worked = time.perf_counter(), time.process_time()
        export_run(folder, Path(temporary) / "map.glb")
        note("export 1 M triangles to GLB, processor time", time.process_time() - worked, "s")
        note("export 1 M triangles to GLB", time.perf_counter() - start, "s", 3)
        try:
            cost, without, watched = view_ms(browser, arguments.frames, arguments.rounds)
        except MissingExtraError as error:
            print(f"--view: left out, {error}")
        else:
            note("--view, processor time per frame", cost, "ms", 3)
            note("median frame without --view", without, "ms")
            note("median frame with --view", watched, "ms")
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
