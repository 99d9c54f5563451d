"""Fixtures that several wings share."""

import sys
import types

import pytest

from fake_slam import StandIn


@pytest.fixture
def slam(monkeypatch):
    """The stand-in in place of ``dudmap.slam.Slam``; tests set ``slam.script``."""
    stand_in = type("Slam", (StandIn,), {"script": {}})
    module = types.ModuleType("dudmap.slam")
    module.Slam = stand_in
    monkeypatch.setitem(sys.modules, "dudmap.slam", module)
    return stand_in
