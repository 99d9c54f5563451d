"""A study as planned: factors, design, recordings and responses of a design file, and the list of all runs."""

import hashlib
import inspect
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from dudmap.config import Config
from dudmap.errors import ConfigError
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.study.designs import DesignOptions, Point, count_of, points_of
from dudmap.lab.study.factors import Factor, configured, make_factors
from dudmap.lab.study.remote import RemoteEntry, is_url, name_of
from dudmap.lab.study.responses import RESPONSES, check_truth, known_responses

SECTIONS = (
    "name", "base", "factors", "design", "sequences", "judge", "responses", "log", "calibrate", "confirm", "each",
    "tune",
)  # fmt: skip
"""Sections of a design file."""
MAX_RUNS = 1000
"""Runs of a design that is not refused unless ``--max-runs`` allows more."""


@dataclass(frozen=True)
class Run:
    """One run: a point of the design on one recording.

    Attributes:
        point: Number of the point in the design; -1 for a confirmation run.
        values: Values of the factors by key.
        entry: The recording.
        sequence: Name of the recording without its replicate.
        replicate: Number of the replicate of a synthetic recording.
        config: All parameters.
        calibrate: Whether the colour camera is calibrated first, as ``dudmap run`` does.
        surfaces: Whether the mesh is scored.
        code: Hash of the code that runs it.
    """

    point: int
    values: Mapping[str, Any]
    entry: Entry
    sequence: str
    replicate: int
    config: Config
    calibrate: bool = False
    surfaces: bool = False
    code: str = ""

    @property
    def key(self) -> str:
        """Hash of everything that the result depends on: the same run has the same folder."""
        content = [
            self.config.model_dump(), place_of(self.entry), dict(self.entry.parameters), self.entry.max_frames,
            self.calibrate, self.surfaces, self.code,
        ]  # fmt: skip
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:20]


@dataclass(frozen=True)
class Plan:
    """A study as a design file describes it; see ``docs/study.md`` for the file.

    Attributes:
        name: Name of the study.
        base: Configuration of the keys that are no factors.
        factors: The factors.
        options: The design.
        entries: Recordings with the name of each without its replicate, and the number of the replicate.
        responses: Names of the responses; the first is optimised, the others are reported beside it.
        log: Names of the responses that are analysed as logarithms.
        calibrate: Whether every run calibrates the colour camera first, as ``dudmap run`` does.
        confirm: Number of confirmation runs per recording at the predicted optimum; 0 omits them.
        each: Whether every recording also has a model and a confirmation of its own.
        code: Hash of the code.
        tune: Options of ``dudmap study tune``.
        judges: Recordings, as ``entries``, on which ``dudmap study tune`` judges.
    """

    name: str
    base: Config
    factors: tuple[Factor, ...]
    options: DesignOptions
    entries: tuple[tuple[str, int, Entry], ...]
    responses: tuple[str, ...]
    log: tuple[str, ...] = ()
    calibrate: bool = False
    confirm: int = 1
    each: bool = False
    code: str = ""
    tune: Mapping[str, Any] = field(default_factory=dict)
    judges: tuple[tuple[str, int, Entry], ...] = ()

    def runs(self) -> list[Run]:
        """All runs of the design, recording by recording."""
        points = points_of(self.factors, self.options)
        runs = [run for number, point in enumerate(points) for run in self.runs_at(number, point)]
        names = [entry.name for _, _, entry in self.entries]
        return sorted(runs, key=lambda run: names.index(run.entry.name))  # a worker keeps a recording for its next run

    def runs_at(self, number: int, point: Point) -> list[Run]:
        """Runs of one point on all recordings."""
        config = configured(self.base, point)
        surfaces = any(RESPONSES[name].needs == "surface" for name in self.responses)
        return [
            Run(number, point, entry, name, replicate, config, self.calibrate, surfaces, self.code)
            for name, replicate, entry in self.entries
        ]

    def confirmation_runs(self, point: Point) -> list[Run]:
        """Runs at the predicted optimum: on every real recording, and on synthetic ones with seeds never seen."""
        out = []
        for name in dict.fromkeys(name for name, _, _ in self.entries):
            same = [(replicate, entry) for other, replicate, entry in self.entries if other == name]
            if same[0][1].path is not None:
                entries = same[:1]
            else:
                last = max(int(entry.parameters["seed"]) for _, entry in same)
                entries = [(-1 - n, _with_seed(same[0][1], last + 1 + n)) for n in range(self.confirm)]
            fresh = replace(
                self,
                entries=tuple((name, replicate, entry) for replicate, entry in entries),
                responses=self.responses[:1],
            )
            out += fresh.runs_at(-1, point)
        return out

    def check(self, max_runs: int = MAX_RUNS) -> None:
        """Check everything that can be known before anything is run.

        Raises:
            DudmapError: The design has more than ``max_runs`` runs, a combination of levels is invalid, or a recording
                is missing or lacks the truth that a response needs.
        """
        count = count_of(self.factors, self.options) * len(self.entries)
        if count > max_runs:
            raise ConfigError(f"the design has {count} runs, more than --max-runs {max_runs}")
        for point in points_of(self.factors, self.options):
            configured(self.base, point)
        for _, _, entry in self.entries:
            try:
                sequence = entry.open()
            except TypeError as error:
                raise ConfigError(f"the synthetic sequence {entry.name} cannot be made: {error}") from None
            check_truth(entry, sequence, self.responses)


def load_plan(path: str | Path) -> Plan:
    """Plan of a design file. Paths of recordings are relative to it.

    Raises:
        ConfigError: The file is missing, not TOML, or describes no valid study.
    """
    path = Path(path)
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the design {path}: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"the design {path} is not valid TOML: {error}") from error
    return make_plan(tree, path.parent, path.stem)


def make_plan(tree: Mapping[str, Any], folder: Path = Path(), name: str = "study") -> Plan:
    """Plan of the tree of a design file; see ``load_plan``."""
    for section in tree:
        if section not in SECTIONS:
            raise ConfigError(f"unknown section {section!r} of the design; known are {', '.join(SECTIONS)}")
    settings = tree.get("base", [])
    if not isinstance(settings, list):
        raise ConfigError(f'base is {settings!r}; expected a list of settings such as ["preset=thesis"]')
    base = Config().override(settings)
    factors = make_factors(tree.get("factors", {}), base)
    responses = known_responses(tree.get("responses", ["ate", "ms"]))
    log = known_responses(tree["log"]) if tree.get("log") else ()
    options = _options(tree.get("design", {}))
    confirm = tree.get("confirm", 1)
    if not isinstance(confirm, int) or confirm < 0:
        raise ConfigError(f"confirm is {confirm!r}; expected the number of confirmation runs, 0 or more")
    for key, expected in (("calibrate", bool), ("each", bool), ("tune", dict)):
        if key in tree and not isinstance(tree[key], expected):
            raise ConfigError(f"{key} is {tree[key]!r}; expected {'true or false' if expected is bool else 'a table'}")
    return Plan(
        str(tree.get("name", name)), base, factors, options,
        make_entries(tree.get("sequences", []), folder), responses, log,
        tree.get("calibrate", False), confirm, tree.get("each", False), method_hash(), tree.get("tune", {}),
        make_entries(tree["judge"], folder) if tree.get("judge") else (),
    )  # fmt: skip


def method_hash() -> str:
    """Hash of all code that a result depends on: all but the commands and the analysis of studies."""
    from dudmap.lab.benchmark.limits import code_hash

    return code_hash(without=("cli", "lab/study"))


def _options(table: object) -> DesignOptions:
    table = {"kind": table} if isinstance(table, str) else table
    if not isinstance(table, dict):
        raise ConfigError(f"design is {table!r}; expected a table with kind, samples, ...")
    return DesignOptions(**checked_options(table, DesignOptions, "the design"))


def checked_options(table: Mapping[str, Any], options: type, what: str) -> dict[str, Any]:
    """Options of a table of a design file, whose names and types are those of the fields of a class.

    Raises:
        ConfigError: An option is unknown, has another type, or is a number of samples or trials below 1.
    """
    known = {option.name: type(option.default) for option in fields(options)}
    for key, value in table.items():
        if key not in known:
            raise ConfigError(f"unknown option {key!r} of {what}; known are {', '.join(known)}")
        number = known[key] is float and type(value) is int
        if (type(value) is not known[key] and not number) or (key in ("samples", "trials") and value < 1):
            raise ConfigError(f"option {key} of {what} is {value!r}; expected a {known[key].__name__}")
    return dict(table)


def make_entries(tables: object, folder: Path) -> tuple[tuple[str, int, Entry], ...]:
    """Recordings of the tables ``sequences`` of a design file: name, replicate and entry of each.

    Raises:
        ConfigError: There is none, or one is malformed.
    """
    if not isinstance(tables, list) or not tables:
        raise ConfigError('the design has no sequences; expected, for example, [[sequences]] path = "recordings/desk"')
    out: list[tuple[str, int, Entry]] = []
    for table in tables:
        if not isinstance(table, dict):
            raise ConfigError(f"sequence {table!r} is no table; expected [[sequences]] with path or scene")
        out += _real(table, folder) if "path" in table else _synthetic(table)
    names = [entry.name for _, _, entry in out]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"two sequences have the name {name!r}; give each a name of its own")
    return tuple(out)


def place_of(entry: Entry) -> str | None:
    """Where a recording is: its URL, its absolute path, or None of a synthetic one."""
    if isinstance(entry, RemoteEntry):
        return entry.url
    return None if entry.path is None else str(entry.path.resolve())


def _real(table: dict[str, Any], folder: Path) -> list[tuple[str, int, Entry]]:
    for key in table:
        if key not in ("name", "path", "frames"):
            raise ConfigError(f"a recording has no {key!r}; known are name, path and frames")
    text, frames = str(table["path"]), _count(table, "frames", None)
    if is_url(text):
        name = str(table.get("name", name_of(text).partition(".")[0]))
        return [(name, 0, RemoteEntry(name, Path(text), max_frames=frames, url=text))]
    path = folder / Path(text).expanduser()
    name = str(table.get("name", path.resolve().name))
    return [(name, 0, Entry(name, path, max_frames=frames))]


def _synthetic(table: dict[str, Any]) -> list[tuple[str, int, Entry]]:
    from dudmap.lab.synthetic import sequence

    known = set(inspect.signature(sequence).parameters)
    for key in table:
        if key not in known | {"name", "replicates"}:
            raise ConfigError(f"a synthetic sequence has no parameter {key!r}; known are {', '.join(sorted(known))}")
    parameters = {key: value for key, value in table.items() if key in known}
    camera = parameters.get("camera")
    if camera is not None and not (
        isinstance(camera, list) and len(camera) == 2 and all(type(n) is int for n in camera)
    ):
        raise ConfigError(f"camera of a synthetic sequence is {camera!r}; expected [width, height] in pixels")
    count, seed = _count(table, "replicates", 1), parameters.get("seed", 0)
    assert count is not None
    if type(seed) is not int:
        raise ConfigError(f"seed of a synthetic sequence is {seed!r}; expected a whole number")
    name = str(table.get("name", parameters.get("scene", "room")))
    entries = [_with_seed(Entry(name, parameters=parameters), seed + n) for n in range(count)]
    return [(name, n, entry if count > 1 else replace(entry, name=name)) for n, entry in enumerate(entries)]


def _count(table: Mapping[str, Any], key: str, usual: int | None) -> int | None:
    value = table.get(key, usual)
    if value is not None and (type(value) is not int or value < 1):
        raise ConfigError(f"{key} of a sequence is {value!r}; expected a whole number of 1 or more")
    return value


def _with_seed(entry: Entry, seed: int) -> Entry:
    base = entry.name.rpartition("#")[0] or entry.name
    return replace(entry, name=f"{base}#{seed}", parameters={**entry.parameters, "seed": seed})


def sequence_names(plan: Plan) -> Sequence[str]:
    """Names of the recordings without their replicates."""
    return list(dict.fromkeys(name for name, _, _ in plan.entries))
