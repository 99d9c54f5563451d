"""Merging of maps: relative poses of runs that overlap, and false joins of places that only look alike.

python benchmarks/merging.py [--quick] [--out FILE.json]

Joined pairs: the system itself runs over two recordings of one rendered place (other paths, other noise), and the maps
are merged as `dudmap merge` does. Pairs without overlap: maps from true poses of different places, among them the same
room and the same corridor with all small things moved, with other textures, and with everything turned round; every
pair of them is tried.
"""

import argparse
import itertools
import json
import sys
import time
from pathlib import Path

import numpy as np

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.slam import Slam
from dudmap.fleet.map_merging import compare_maps

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from rendered_places import CAMERA, TrueMap, looking_elsewhere, rearranged, record, retextured, true_map

PAIRS = (
    ("room", (1, "pan"), (3, "handheld")),
    ("room", (5, "handheld"), (6, "orbit")),
    ("corridor", (1, "handheld"), (2, "dolly")),
    ("yard", (1, "handheld"), (2, "orbit")),
    ("desk", (1, "handheld"), (2, "orbit")),
)
CHANGES = {
    "": None,
    "turned": looking_elsewhere,
    "other textures": lambda scene: retextured(scene, 1),
    "other textures 2": lambda scene: retextured(scene, 2),
    "other things": lambda scene: retextured(scene, 3, walls=False),
    "rearranged": lambda scene: rearranged(scene, 1),
    "rearranged 2": lambda scene: rearranged(scene, 2),
}
"""Look-alikes of a place."""


def system_run(scene: str, seed: int, path: str, frames: int) -> TrueMap:
    """What the system makes of a recording."""
    recording = record(scene, seed, path, frames)
    slam = Slam(CAMERA, Config())
    for index in range(len(recording)):
        slam.process(recording[index])
    return TrueMap(slam.saved_map, recording.ground_truth.Ts_world_camera[0])


def joined_pairs(pairs, frames: int) -> list[dict]:
    """Errors of the relative poses of overlapping runs."""
    rows = []
    for scene, first, second in pairs:
        a, b = system_run(scene, *first, frames), system_run(scene, *second, frames)
        start = time.perf_counter()
        pair = compare_maps(a.saved, b.saved)
        row = {"pair": f"{scene} {first} {second}", "seconds": round(time.perf_counter() - start, 1)} | pair.tree()
        if pair.T_a_b is not None:
            error = se3.inverse(a.T_world_other(b)) @ pair.T_a_b
            row["error_mm"] = round(1000 * float(np.linalg.norm(error[:3, 3])), 2)
            row["error_deg"] = round(float(np.degrees(se3.rotation_angle(error))), 4)
        row.pop("T_a_b", None)
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def separate_pairs(limit: int | None) -> list[dict]:
    """Decisions on pairs of places without overlap."""
    places = {("desk", ""): true_map(record("desk", 11, "handheld"))}
    places["yard", ""] = true_map(record("yard", 12, "pan"))
    places["yard", "rearranged"] = true_map(record("yard", 13, "handheld", change=lambda scene: rearranged(scene, 3)))
    places["desk", "rearranged"] = true_map(record("desk", 14, "orbit", change=lambda scene: rearranged(scene, 4)))
    places["desk", "other things"] = true_map(
        record("desk", 15, "orbit", change=lambda scene: retextured(scene, 5, walls=False))
    )
    for number, (scene, (name, change)) in enumerate(itertools.product(("room", "corridor"), CHANGES.items())):
        path = "pan" if scene == "room" else "handheld"
        places[scene, name] = true_map(record(scene, 20 + number, path, change=change))
    rows = []
    for (name_a, a), (name_b, b) in itertools.islice(itertools.combinations(places.items(), 2), limit):
        pair = compare_maps(a.saved, b.saved)
        row = {"pair": f"{' '.join(name_a).strip()} | {' '.join(name_b).strip()}", "joined": pair.T_a_b is not None}
        row |= pair.tree()
        row.pop("T_a_b", None)
        rows.append(row)
        if pair.hypothesis is not None:
            print(json.dumps(row), flush=True)
    return rows


def main() -> None:
    """Print both tables and a summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one overlapping pair, ten without overlap")
    parser.add_argument("--out", type=Path, help="write all rows as JSON")
    options = parser.parse_args()
    joined = joined_pairs(PAIRS[:1] if options.quick else PAIRS, 60 if options.quick else 100)
    separate = separate_pairs(10 if options.quick else None)
    right = [row for row in joined if row.get("error_mm", np.inf) < 10 and row["error_deg"] < 0.2]
    false = [row for row in separate if row["joined"]]
    print(f"joined within 1 cm and 0.2 deg: {len(right)} of {len(joined)}")
    print(f"false joins: {len(false)} of {len(separate)} pairs without overlap")
    if options.out:
        options.out.write_text(json.dumps({"joined": joined, "separate": separate}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
