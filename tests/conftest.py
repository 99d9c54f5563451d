"""Fixtures of several test folders."""

import sys
import types

import pytest

from fake_slam import FakeSlam


@pytest.fixture
def slam(monkeypatch):
    """Replace ``dudmap.slam.Slam`` by ``FakeSlam``; tests set ``slam.script``."""
    fake = type("Slam", (FakeSlam,), {"script": {}})
    module = types.ModuleType("dudmap.slam")
    module.Slam = fake
    monkeypatch.setitem(sys.modules, "dudmap.slam", module)
    return fake
