"""Valid inputs of all loaders."""

import os

import pytest
from trial import Subject


@pytest.fixture(scope="module")
def subjects(tmp_path_factory):
    """Valid inputs by the name of their loader, written when first asked for."""
    made = {}

    def subject(name):
        if name not in made:
            if name == "record3d":
                pytest.importorskip("lzfse")
            if "bag" in name or "RealSense" in name:
                pytest.importorskip("rosbags")
            made[name] = Subject(name, tmp_path_factory.mktemp("fuzz") / "a")
        return made[name]

    before = os.environ.get("DUDMAP_CACHE")
    yield subject
    os.environ.pop("DUDMAP_CACHE", None)
    if before is not None:
        os.environ["DUDMAP_CACHE"] = before
