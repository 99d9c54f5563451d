"""Chapter 6 of the thesis as studies: the factors, levels and results of its tables."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from dudmap.errors import ConfigError
from dudmap.lab.study.designs import Table
from dudmap.lab.study.plan import Plan, make_plan

HUBER, DAMPING, VOXEL, WEIGHT = "tracker.huber", "tracker.damping", "volume.voxel_size", "tracker.color_weight"
TABLES: Mapping[str, dict[str, list[float]]] = {
    "6.1": {HUBER: [0.005, 0.01, 0.025], DAMPING: [0.002, 0.01, 0.02], VOXEL: [0.01, 0.02, 0.05],
            WEIGHT: [0.025, 0.1, 0.175]},
    "6.2": {WEIGHT: [0.1, 0.11, 0.12, 0.125, 0.1275, 0.13, 0.1325, 0.14, 0.15, 0.175]},
    "6.3": {VOXEL: [0.005, 0.01, 0.02, 0.05], WEIGHT: [0.01, 0.025, 0.04]},
}  # fmt: skip
"""Factors and levels: table 6.1 with figures 6.1, 6.2 and 6.4, table 6.2 with figure 6.3, and table 6.3. The other keys
have the values of preset ``thesis``, which are those of the thesis in tables 6.2 and 6.3."""
ROOM: dict[str, Any] = {
    "name": "room", "scene": "room", "movers": ["person"], "frames": 240, "camera": [320, 240],
}  # fmt: skip
"""Recording of a study without any: a synthetic room with a walking person. The thesis took freiburg3_walking_xyz for
tables 6.1 and 6.2 and freiburg3_walking_static for table 6.3."""
PUBLISHED_CONFIRMATION = 89.0
"""ATE that the thesis measured at its quadratic optimum, millimetres (section 6.1)."""


def thesis_plan(table: str = "6.1", recordings: Sequence[Path] = (), frames: int | None = None) -> Plan:
    """Plan of table 6.1, 6.2 or 6.3 of the thesis, on ``ROOM`` unless recordings are named.

    Raises:
        ConfigError: There is no such table.
    """
    if table not in TABLES:
        raise ConfigError(f"there is no study of table {table!r}; known are {', '.join(TABLES)}")
    some = {} if frames is None else {"frames": frames}
    return make_plan(
        {
            "name": f"thesis, table {table}",
            "base": ["preset=thesis"],
            "factors": TABLES[table],
            "sequences": [{"path": str(path.absolute()), **some} for path in recordings] or [{**ROOM, **some}],
        }
    )


def published_table() -> Table:
    """The 81 values of table 6.1 as runs: ATE RMSE in metres on freiburg3_walking_xyz."""
    import pandas as pd

    with (files("dudmap.lab.study") / "thesis_table_6_1.csv").open(encoding="utf-8") as file:
        given = pd.read_csv(file)
    columns = {"huber": HUBER, "damping": DAMPING, "voxel_size": VOXEL, "color_weight": WEIGHT, "ate_m": "ate_rmse_m"}
    return given.rename(columns=columns).assign(
        run=given.index, point=given.index, sequence="freiburg3_walking_xyz", replicate=0
    )


def published_report(out: Path) -> str:
    """Analyse the values of table 6.1 as the thesis printed them; write the report and return the outcome.

    The confirmation is the thesis' own: 0.089 m at its optimum, 0.080 m at the best point of the design.
    """
    from dudmap.lab.study.response_surface import confirm, predict_optimum
    from dudmap.lab.study.study import write_report

    plan, table = thesis_plan(), published_table()
    recording = (str(table["sequence"][0]), 0, plan.entries[0][2])
    plan = replace(plan, name="thesis, table 6.1 as published", entries=(recording,), responses=("ate",))
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "runs.csv", index=False)
    scale = plan.scale("ate")
    data = scale.usable(table)
    predicted = predict_optimum(data, plan.factors, scale)
    assert not isinstance(predicted, str)
    confirmation = confirm(predicted.surface, predicted.best, [PUBLISHED_CONFIRMATION], [float(data["ate"].min())])
    return write_report(plan, table, predicted, confirmation, out, "nothing was run")
