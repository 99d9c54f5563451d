"""Arguments of the commands that take long, and what stands in place of their measurements in tests."""

from types import SimpleNamespace


def merged(*_):
    return {"features": 9, "keyframes": 2, "area": 1.0, "denied": 0.0, "color_correlation": float("nan"),
            "finer_blocks_left_out": 0}  # fmt: skip


FAKED = {
    "warmup": (["warmup"], {"dudmap.lab.warmup.steps": lambda: [("part", lambda: None)]}),
    "merge": (["merge", "a", "b"], {"dudmap.fleet.merge.merge_runs": lambda *_: merged()}),
    "diff": (
        ["diff", "a", "b"],
        {"dudmap.fleet.diff.diff_runs": lambda *_: {"notes": [], "changes": [], "counts": {}}},
    ),
    "benchmark changes": (
        ["benchmark", "changes"],
        {"dudmap.fleet.change_benchmark.measure_changes": lambda *_: ([], "")},
    ),
    "calibrate": None,  # tests/calibration/test_self_calibration.py
    "benchmark consistency": None,  # tests/benchmark/test_consistency.py
    "benchmark gate": (
        ["benchmark", "gate"],
        {
            "dudmap.lab.benchmark.gate.load_figures": lambda _: {},
            "dudmap.lab.benchmark.gate.gate_entries": lambda _: [],
            "dudmap.lab.benchmark.gate.measure_gate": lambda *_: [],
            "dudmap.lab.benchmark.gate.compare": lambda *_: [],
        },
    ),
    "benchmark random": (
        ["benchmark", "random", "--out", "."],
        {
            "dudmap.lab.benchmark.random_worlds.measure_worlds": lambda *_: [],
            "dudmap.lab.benchmark.random_worlds.report": lambda *_: "",
        },
    ),
    "benchmark gpu": (
        ["benchmark", "gpu", "--out", "gpu"],
        {"dudmap.lab.benchmark.gpu.measure_devices": lambda *_: [], "dudmap.lab.benchmark.gpu.table": lambda _: ""},
    ),
    "benchmark faults": (
        ["benchmark", "faults"],
        {
            "dudmap.lab.benchmark.stream_faults.default_room": lambda *_: SimpleNamespace(name="room"),
            "dudmap.lab.benchmark.stream_faults.measure_stream_faults": lambda *_: [],
        },
    ),
    "benchmark speed": (
        ["benchmark", "speed", "--out", "speed"],
        {"dudmap.lab.benchmark.speed.speed_figures": lambda *_: [], "dudmap.lab.benchmark.speed.stages": lambda: ""},
    ),
    "benchmark soak": (
        ["benchmark", "soak"],
        {"dudmap.lab.benchmark.soak.measure_soak": lambda *_: [], "dudmap.lab.benchmark.soak.grown": lambda _: []},
    ),
    "benchmark compile": (
        ["benchmark", "compile"],
        {"dudmap.lab.benchmark.measure.in_own_process": lambda *_: {"rows": {}}},
    ),
    "benchmark calls": (["benchmark", "calls"], {"dudmap.lab.benchmark.calls.count_calls": lambda *_: []}),
    "study run": (
        ["study", "design.toml"],
        {
            "dudmap.lab.study.plan.load_plan": lambda _: None,
            "dudmap.lab.study.study.run_study": lambda *_, **__: "an outcome",
        },
    ),
    "study tune": (
        ["study", "tune", "design.toml"],
        {
            "dudmap.lab.study.plan.load_plan": lambda _: None,
            "dudmap.lab.study.tune.run_tune": lambda *_, **__: "an outcome",
        },
    ),
    "study thesis": (
        ["study", "thesis", "--published", "--out", "published"],
        {"dudmap.lab.study.study.published_report": lambda _: "an outcome"},
    ),
}
"""Long commands, with their measurements replaced."""
