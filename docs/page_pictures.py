"""Draw the pictures of the demo, its pages and the worlds: demo.jpg, synthetic.jpg, report-page.jpg, view-page.jpg.

python docs/page_pictures.py [FOLDER]     # by default docs; needs the extra view, playwright and a Chromium
"""

import os
import shutil
import socket
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import BrowserContext, sync_playwright

from dudmap.app.viewing.live_view import open_run
from dudmap.app.viewing.report import REPORT
from dudmap.app.viewing.snapshot import depth_colors
from dudmap.cli import app
from dudmap.lab import synthetic

DOCS = Path(__file__).parent
SHOWN = 70
"""Frame of the demo in which the person is in the middle."""
WEBGL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
"""Arguments with which WebGL works without a graphics card."""
WORLDS = (
    ("room", ["person"], 66), ("corridor", ["people"], 60), ("desk", ["person"], 84), ("yard", ["people"], 80),
    ("textureless", ["carried_box"], 60), ("plane", ["balloon"], 88),
)  # fmt: skip


def main() -> None:
    """Write all pictures into the named folder, by default into the documentation."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack([world(*row) for row in WORLDS])).save(folder / "synthetic.jpg", quality=88)
    with tempfile.TemporaryDirectory() as made, sync_playwright() as playwright:
        run = Path(made) / "demo"
        app(["demo", "--out", str(run), "--quiet"], standalone_mode=False)
        Image.open(run / "demo.png").convert("RGB").save(folder / "demo.jpg", quality=88)
        program = os.environ.get("DUDMAP_CHROMIUM") or shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=program, args=WEBGL).new_context()
        browser.set_default_timeout(300_000)  # drawn without a graphics card
        report_page(browser, run, folder / "figures" / "report-page.jpg")
        view_page(browser, run, folder / "figures" / "view-page.jpg")
        browser.close()


def world(scene: str, movers: list[str], frame: int) -> NDArray[np.uint8]:
    """Colour, measured depth and true mask of a frame, one below the other."""
    sequence = synthetic.sequence(scene, movers=movers, camera=(256, 192), noise="kinect", seed=0)
    mask = np.where(sequence.mask(frame)[..., None], np.uint8(255), np.zeros(3, dtype=np.uint8))
    return np.vstack([sequence[frame].rgb, depth_colors(sequence[frame].depth), mask])


def report_page(browser: BrowserContext, run: Path, out: Path) -> None:
    """Photograph the report of a run with a person in the view."""
    page = browser.new_page()
    page.set_viewport_size({"width": 1100, "height": 1130})
    page.goto((run / REPORT).as_uri())
    page.wait_for_selector("html[data-ready=true]")
    page.evaluate(f"time.value = {SHOWN}; time.dispatchEvent(new Event('input'))")
    page.wait_for_timeout(1000)
    page.screenshot(path=out, quality=85)


def view_page(browser: BrowserContext, run: Path, out: Path) -> None:
    """Photograph the page of ``dudmap view``, with a measured distance."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    window = open_run(run, "127.0.0.1", port)
    window.show_frame(SHOWN)
    page = browser.new_page()
    page.set_viewport_size({"width": 1100, "height": 820})
    page.goto(window.url)
    page.get_by_role("alert").get_by_role("button").click()  # "software rendering"
    for x in (-0.42, -0.2):  # the width of a poster, as two clicks would
        window.mark((0, 0, 0), (x, -0.2, 1))
    page.wait_for_timeout(30_000)
    page.screenshot(path=out, quality=85)
    window.stop()


if __name__ == "__main__":
    main()
