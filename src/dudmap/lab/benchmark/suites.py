"""Benchmark suites: their recordings and the addresses these can be downloaded from."""

from dataclasses import dataclass, replace
from pathlib import Path

from dudmap.errors import ConfigError, DatasetError
from dudmap.io.sequences.archive import is_archive, stem
from dudmap.lab.benchmark.entries import Entry, local_entries

TUM = "https://cvg.cit.tum.de/data/datasets/rgbd-dataset/download"
BONN = "https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/"
ICL_NUIM = "https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html"
# CoRBS and VolumeDeform: addresses given in public code that uses them; not checked.
CORBS = "http://corbs.dfki.uni-kl.de/"
VOLUMEDEFORM = "https://cloud9.cs.fau.de/index.php/s/46qcNZSNePHx08A"

SUITES: dict[str, str] = {
    "synthetic": "Synthetic worlds with exact ground truth; needs no data.",
    "ablation": "Five small synthetic worlds, the default with one part switched off at a time.",
    "thesis": "The recordings of tables 5.1 to 5.8 of the DUDMap thesis.",
    "tum-dynamic": "The eight fr3 sitting and walking recordings of TUM RGB-D.",
    "bonn": "The 24 dynamic and 2 static recordings of Bonn RGB-D Dynamic.",
    "icl-nuim": "The ICL-NUIM living room, with and without sensor noise.",
    "local": "Every recording in a folder.",
}

FR3 = [
    f"rgbd_dataset_freiburg3_{pose}_{motion}"
    for pose in ("sitting", "walking")
    for motion in ("static", "xyz", "rpy", "halfsphere")
]
BONN_NAMES = (
    "balloon balloon2 balloon_tracking balloon_tracking2 crowd crowd2 crowd3 kidnapping_box kidnapping_box2 "
    "moving_nonobstructing_box moving_nonobstructing_box2 moving_obstructing_box moving_obstructing_box2 "
    "person_tracking person_tracking2 placing_nonobstructing_box placing_nonobstructing_box2 "
    "placing_nonobstructing_box3 placing_obstructing_box removing_nonobstructing_box removing_nonobstructing_box2 "
    "removing_obstructing_box synchronous synchronous2 static static_close_far"
).split()
SYNTHETIC: dict[str, dict[str, object]] = {
    "room-static": {"movers": ()},
    "room-person": {},
    "room-people-at-start": {"situation": "people_at_start"},
    "room-crowd-50": {"coverage": 0.5, "frames": 150},
    "room-follow": {"situation": "follow"},
    "room-blocked": {"situation": "blocked"},
    "room-kidnapped": {"situation": "kidnapped", "frames": 150},
    "room-stops": {"situation": "stops", "frames": 150},
    "room-starts": {"situation": "starts", "frames": 150},
    "room-put-down": {"situation": "put_down", "frames": 150},
    "room-taken-away": {"situation": "taken_away", "frames": 150},
    "room-creeper": {"movers": ("creeper",)},
    "room-fast-camera": {"camera_path": "fast"},
    "room-blur-exposure": {"motion_blur": 0.5, "exposure_change": 0.15},
    "corridor-person": {"scene": "corridor"},
    "desk-ball": {"scene": "desk", "movers": ("ball",)},
    "yard-people": {"scene": "yard", "movers": ("people",)},
    "textureless-person": {"scene": "textureless"},
    "plane-person": {"scene": "plane"},
    "room-realsense": {"noise": "realsense"},
}
WORLDS: dict[str, dict[str, dict[str, object]]] = {
    "synthetic": SYNTHETIC,
    "ablation": {
        name: {"frames": 90, "camera": (320, 240), **world}
        for name, world in {
            "two-people": {"movers": ("people",)},
            "crowd-from-the-start": {"coverage": 0.4, "start_dynamic": True},
            "slow-creeper": {"movers": ("creeper",)},
            "an-object-starts-to-move": {"situation": "starts"},
            "kidnapped": {"situation": "kidnapped"},
        }.items()
    },
}
"""Worlds of the suites that need no data."""
ROOM = {"movers": (), "frames": 120}
UNREGISTERED = {"color_translation": (0.025, 0.0, 0.0), "color_focal_ratio": 0.95}
DELAY = {"color_delay": 0.025}
ROLLING = {"color_readout": 0.025}
EXPOSURE = {"auto_exposure": 0.3, "white_balance_drift": 0.05, "vignetting": 0.3}
SENSORS: dict[str, dict[str, object]] = {
    "clean": {},
    "unregistered": {"faults": UNREGISTERED},
    "delay": {"faults": DELAY},
    "rolling-blur": {"faults": ROLLING, "motion_blur": 0.5},
    "exposure": {"faults": EXPOSURE},
    "all-colour-faults": {"faults": UNREGISTERED | DELAY | ROLLING | EXPOSURE, "motion_blur": 0.5},
    "depth-faults": {"faults": {"depth_distortion": 0.01, "depth_bands": 0.001, "depth_scale_error": 0.005}},
    **{
        name: {"sensor": name}
        for name in ("kinect_v1", "kinect_v2", "realsense_d435", "realsense_l515", "iphone_lidar")
    },
}
"""The same static room, taken with sensors of different faults and with named cameras."""
QUICK = ("room-static", "room-person", "room-people-at-start", "two-people")


@dataclass(frozen=True)
class Suite:
    """Recordings of a suite.

    Attributes:
        name: Name of the suite.
        entries: Recordings that were found.
        missing: Recordings that were not found.
    """

    name: str
    entries: list[Entry]
    missing: list[Entry]

    def names(self) -> list[str]:
        """Names of all recordings of the suite, found or not."""
        return [entry.name for entry in [*self.entries, *self.missing]]


def find_suite(name: str, data: Path | None, *, quick: bool = False) -> Suite:
    """Find the recordings of a suite.

    Args:
        name: One of ``SUITES``.
        data: Folder that is searched, two levels deep, for the recordings; synthetic worlds need none.
        quick: Only one to three synthetic worlds, and at most 60 frames of every recording.

    Raises:
        ConfigError: There is no such suite, or it needs ``data``.
        DatasetError: ``data`` is no folder, or for the suite ``local`` holds no recording.
    """
    if name not in SUITES:
        raise ConfigError(f"unknown suite {name!r}; known suites: {', '.join(SUITES)}")
    if name in WORLDS:
        worlds = WORLDS[name].items()
        chosen = [Entry(key, parameters=world) for key, world in worlds if not quick or key in QUICK]
        return Suite(name, [_short(entry) for entry in chosen] if quick else chosen, [])
    if data is None:
        raise ConfigError(f"the suite {name} reads recordings from disk; name their folder with --data")
    if name == "local":
        found, missing = local_entries(data), []
    else:
        if not data.is_dir():
            raise DatasetError(f"there is no folder {data}; expected one that holds recordings")
        found, missing = _located(_entries(name), data)
    return Suite(name, [_short(entry) for entry in found] if quick else found, missing)


def sensor_entries(names: list[str] | None = None, *, quick: bool = False) -> list[Entry]:
    """The room of suite ``sensors``, taken with every sensor or with the named ones, ``quick`` in small images.

    Raises:
        ConfigError: A name is unknown.
    """
    unknown = [name for name in names or [] if name not in SENSORS]
    if unknown:
        raise ConfigError(f"unknown sensor of the suite {unknown[0]!r}; known are {', '.join(SENSORS)}")
    size = {"camera": (320, 240) if quick else (640, 480)}
    return [Entry(name, parameters=ROOM | size | SENSORS[name]) for name in names or SENSORS]


def _short(entry: Entry) -> Entry:
    if entry.path is None:
        return replace(entry, parameters={**entry.parameters, "frames": 60})
    return replace(entry, max_frames=60)


def _entries(suite: str) -> list[Entry]:
    tum = [Entry(name, address=TUM) for name in FR3]
    bonn = [Entry(f"rgbd_bonn_{name}", address=BONN) for name in BONN_NAMES]
    rooms = [f"living_room_traj{number}{kind}_frei_png" for kind in ("n", "") for number in range(4)]
    icl = [Entry(name, address=ICL_NUIM) for name in rooms]
    if suite == "tum-dynamic":
        return tum
    if suite == "bonn":
        return bonn
    if suite == "icl-nuim":
        return icl
    named = ("sitting_static", "sitting_xyz", "walking_static", "walking_xyz", "walking_halfsphere")
    boxes = ("rgbd_bonn_balloon_tracking2", "rgbd_bonn_moving_obstructing_box")
    return [
        *(entry for entry in icl if entry.name == "living_room_traj2n_frei_png"),
        *(Entry(name, address=CORBS) for name in ("D1", "E1")),
        *(entry for entry in tum if entry.name.endswith(named)),
        *(entry for entry in bonn if entry.name in boxes),
        *(Entry(name, address=VOLUMEDEFORM) for name in ("boxing", "sunflower")),
    ]


def _located(entries: list[Entry], data: Path) -> tuple[list[Entry], list[Entry]]:
    """Entries whose folder or archive is found in ``data`` or one level below, and the others.

    The images of a CoRBS scene are in ``<name>_pre_registereddata``, as downloaded.
    """
    places = [path for pattern in ("*/*", "*") for path in sorted(data.glob(pattern))]
    found = {stem(path): path for path in places if is_archive(path)} | {p.name: p for p in places if p.is_dir()}
    for name in list(found):
        found.setdefault(name.removesuffix("_pre_registereddata"), found[name])
    located = [replace(entry, path=found[entry.name]) for entry in entries if entry.name in found]
    return located, [entry for entry in entries if entry.name not in found]
