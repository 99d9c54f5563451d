import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.config import Config
from dudmap.lab.benchmark import measure, random_worlds
from dudmap.lab.benchmark.random_worlds import DRAWN, draw_world, measure_worlds, report
from dudmap.lab.benchmark.suites import Entry
from dudmap.lab.synthetic import names


def row(world, ate, lost=0, frames=100):
    figures = {"ate_rmse_m": ate, "lost": lost, "frames": frames}
    return {"seed": 3, "world": world, "parameters": draw_world(3, world)} | figures


def test_worlds_depend_on_seed_and_number_only():
    assert draw_world(3, 7) == draw_world(3, 7)
    assert draw_world(3, 7) != draw_world(3, 8)
    assert draw_world(3, 7) != draw_world(4, 7)


def test_worlds_are_varied_and_of_known_parts():
    worlds = [draw_world(11, number) for number in range(300)]
    known = names()
    assert {world["scene"] for world in worlds} == set(DRAWN["scenes"]) <= set(known["scenes"])
    assert {world["camera_path"] for world in worlds} <= set(known["camera_paths"])
    assert {world["sensor"] for world in worlds if "sensor" in world} == set(known["sensors"])
    assert {name for world in worlds for name in world.get("movers", ())} == set(known["movers"])
    assert set(DRAWN["noises"]) == set(known["noise"]) - {"none"}
    assert {name for world in worlds for name in world.get("faults", {})} == set(DRAWN["faults"])
    faulty = [world for world in worlds if "faults" in world]
    assert len(faulty) / len(worlds) == pytest.approx(0.6, abs=0.1)


def test_every_fault_can_be_drawn_and_used():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        faults = {name: random_worlds._drawn(name, rng) for name in DRAWN["faults"]}
        world = {"scene": "box", "movers": (), "frames": 3, "camera": (64, 48), "faults": faults}
        recording = Entry("all", parameters=world).open()
        assert recording[len(recording) - 1].depth.max() > 0


def test_silent_failures_are_wrong_but_not_lost():
    rows = [row(0, 0.002), row(1, 0.3, lost=30), row(2, 0.06, lost=19), row(3, 0.049)]
    rows.append({"seed": 3, "world": 4, "parameters": draw_world(3, 4), "error": "no frame could be tracked"})
    text = report(rows, 3)
    assert "| 54.5 | 264.0 | 300.0 | 49 of 400 in 2 worlds | 1 | 1 |" in text
    silent, worst = text.split("Worst worlds:")
    assert "world 2: 60.0 mm, 19 of 100 frames lost" in silent
    assert "world 1" not in silent
    assert worst.index("world 1") < worst.index("world 2") < worst.index("world 3") < worst.index("world 0")
    assert "`dudmap benchmark random --seed 3 --only 2`" in silent
    assert "world 4: no frame could be tracked" in worst
    assert "no world" in report([rows[-1]], 3).lower()


def test_interrupted_run_continues(tmp_path, monkeypatch):
    measured = []

    def fake(function, job):
        measured.append(job[0].name)
        if job[0].name == "world-2" and measured.count("world-2") == 1:
            raise KeyboardInterrupt
        return {"ate_rmse_m": 0.01, "lost": 0, "frames": 90}

    monkeypatch.setattr(measure, "in_own_process", fake)
    with pytest.raises(KeyboardInterrupt):
        measure_worlds(1, range(4), Config(), tmp_path)
    before = measured.copy()
    rows = measure_worlds(1, range(4), Config(), tmp_path)
    assert [r["world"] for r in rows] == [0, 1, 2, 3]
    assert "world-0" in before
    assert measured.count("world-0") == 1
    assert measure_worlds(1, [3], Config(), tmp_path)[0]["parameters"]["scene"] == draw_world(1, 3)["scene"]
    other = Config().override(["tracker.color_weight=0"])
    measure_worlds(1, [3], other, tmp_path)
    assert measured.count("world-3") == 2


def test_wrong_number_of_a_world_is_one_sentence(tmp_path):
    result = CliRunner().invoke(app, ["benchmark", "random", "--only", "a", "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert "cannot understand --only 'a'" in result.output
