"""The Chromium that the tests drive."""

import os
import shutil
from pathlib import Path

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
"""Arguments with which WebGL works without a graphics card."""


def find_chromium() -> str | None:
    """Program of a Chromium: DUDMAP_CHROMIUM, else one on the PATH, else playwright's own; None if there is none."""
    named = os.environ.get("DUDMAP_CHROMIUM")
    if named:
        return named
    for name in PROGRAMS:
        if (found := shutil.which(name)) is not None:
            return found
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    with sync_playwright() as playwright:
        own = playwright.chromium.executable_path
    return own if Path(own).is_file() else None
