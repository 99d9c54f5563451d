"""Plan of a study from a design file, and all its runs. Errors raise a ``ConfigError``, bad recordings a
``DatasetError``."""

import hashlib
import inspect
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dudmap.config import Config
from dudmap.errors import ConfigError
from dudmap.input_files import describe
from dudmap.lab.benchmark.measure import code_hash
from dudmap.lab.benchmark.suites import Entry
from dudmap.lab.data import find
from dudmap.lab.study.designs import DesignOptions, Factor, Point, configured, count_of, make_factors, points_of
from dudmap.lab.study.responses import RESPONSES, Scale, check_truth

MAX_RUNS = 1000
"""Most runs, unless ``--max-runs`` allows more."""
STRICT = ConfigDict(extra="forbid", frozen=True)


class TuneOptions(BaseModel):
    """Table ``tune``: number of configurations, seed."""

    model_config = STRICT

    trials: int = Field(default=40, ge=1)
    seed: int = 0


class RealTable(BaseModel):
    """Table ``sequences`` of a recording."""

    model_config = STRICT

    path: str
    name: str = ""
    frames: int | None = Field(None, ge=1)


class SyntheticTable(BaseModel):
    """Table ``sequences`` of a synthetic recording."""

    model_config = ConfigDict(extra="allow", frozen=True)

    name: str = ""
    scene: str = "room"
    replicates: int = Field(1, ge=1)
    seed: int = 0
    camera: list[int] | None = Field(None, min_length=2, max_length=2, description="[width, height] in pixels")


class DesignFile(BaseModel):
    """A design file; ``docs/study.md`` describes it."""

    model_config = STRICT

    name: str = ""
    base: list[str] = Field([], description='a list of settings such as ["system=thesis"]')
    factors: dict[str, Any] = Field({}, description='a table such as "tracker.huber" = [0.005, 0.01]')
    design: str | dict[str, Any] = Field({}, description="a table with kind, samples, ...")
    sequences: list[dict[str, Any]] = Field([], description="tables [[sequences]] with path or scene")
    judge: list[dict[str, Any]] = Field([], description="tables [[judge]] with path or scene")
    responses: list[str] = Field(["ate", "ms"], min_length=1, description=f"a list of {', '.join(RESPONSES)}")
    log: list[str] = Field([], description="a list of responses")
    calibrate: bool = Field(False, description="true or false")
    confirm: int = Field(1, ge=0, description="the number of confirmation runs, 0 or more")
    tune: dict[str, Any] = Field({}, description="a table with trials and seed")


Checked = TypeVar("Checked", bound=BaseModel)


def checked(kind: type[Checked], given: object, what: str) -> Checked:
    """Validate a table of a design file."""
    try:
        return kind.model_validate(given, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        if not first["loc"]:
            raise ConfigError(f"{what} is {given!r}; expected a table") from None
        key = str(first["loc"][0])
        if first["type"] == "extra_forbidden":
            raise ConfigError(f"unknown key {key!r} of {what}; known are {', '.join(kind.model_fields)}") from None
        expected = kind.model_fields[key].description or first["msg"]
        raise ConfigError(f"{key} of {what} is {first['input']!r}; expected {expected}") from None


@dataclass(frozen=True)
class Run:
    """One run: a point of the design on one recording.

    Attributes:
        point: Number in the design; -1 for a confirmation.
        values: By key.
        entry, sequence, replicate: Recording, name without replicate, replicate number.
        calibrate: Whether the colour camera is calibrated first.
        code: Hash of the code.
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
        """Hash of all inputs; equal runs share a folder."""
        content = [
            self.config.model_dump(), place_of(self.entry), dict(self.entry.parameters), self.entry.max_frames,
            self.calibrate, self.surfaces, self.code,
        ]  # fmt: skip
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:20]


@dataclass(frozen=True)
class Plan:
    """A study as described by a design file (``docs/study.md``).

    Attributes:
        entries: Name without replicate, replicate number, recording.
        responses: Names; the first is optimised.
        judges: Recordings on which ``dudmap study tune`` judges.
    """

    name: str
    base: Config
    factors: tuple[Factor, ...]
    options: DesignOptions
    entries: tuple[tuple[str, int, Entry], ...]
    responses: tuple[str, ...]
    file: DesignFile
    tune: TuneOptions
    judges: tuple[tuple[str, int, Entry], ...]
    code: str

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
            Run(number, point, entry, name, replicate, config, self.file.calibrate, surfaces, self.code)
            for name, replicate, entry in self.entries
        ]

    def confirmation_runs(self, point: Point) -> list[Run]:
        """Runs at the predicted optimum: real recordings, and synthetic ones with new seeds."""
        entries: list[tuple[str, int, Entry]] = []
        for name in self.recordings:
            same = [(replicate, entry) for other, replicate, entry in self.entries if other == name]
            if same[0][1].path is not None:
                entries.append((name, *same[0]))
            else:
                last = max(int(entry.parameters["seed"]) for _, entry in same)
                fresh = [_with_seed(same[0][1], last + 1 + n) for n in range(self.file.confirm)]
                entries += [(name, -1 - n, entry) for n, entry in enumerate(fresh)]
        return replace(self, entries=tuple(entries), responses=self.responses[:1]).runs_at(-1, point)

    @property
    def recordings(self) -> list[str]:
        """Names of the recordings without their replicates."""
        return list(dict.fromkeys(name for name, _, _ in self.entries))

    def scale(self, response: str) -> Scale:
        """Scale on which a response is analysed."""
        return Scale(response, response in self.file.log)

    def check(self, max_runs: int = MAX_RUNS) -> None:
        """Check everything known before the first run."""
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
    """Plan of a design file, with relative paths."""
    path = Path(path)
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the design {path}: {describe(error)}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"the design {path} is not valid TOML: {error}") from error
    return make_plan(tree, path.parent, path.stem)


def make_plan(tree: Mapping[str, Any], folder: Path = Path(), name: str = "study") -> Plan:
    """Plan of a design file's tree."""
    file = checked(DesignFile, tree, "the design")
    base = Config().override(file.base)
    for response in (*file.responses, *file.log):
        find(response, RESPONSES, "response")
    design = {"kind": file.design} if isinstance(file.design, str) else file.design
    return Plan(
        name=file.name or name,
        base=base,
        factors=make_factors(file.factors, base),
        options=checked(DesignOptions, design, "the design"),
        entries=make_entries(file.sequences, folder),
        responses=tuple(dict.fromkeys(file.responses)),
        file=file,
        tune=checked(TuneOptions, file.tune, "tune"),
        judges=make_entries(file.judge, folder) if file.judge else (),
        code=code_hash(without=("cli", "lab/study")),  # inputs of a result
    )


def make_entries(tables: list[dict[str, Any]], folder: Path) -> tuple[tuple[str, int, Entry], ...]:
    """Name, replicate and entry of the tables ``sequences``."""
    if not tables:
        raise ConfigError('the design has no sequences; expected, for example, [[sequences]] path = "recordings/desk"')
    out: list[tuple[str, int, Entry]] = []
    for table in tables:
        out += [_real(table, folder)] if "path" in table else _synthetic(table)
    names = [entry.name for _, _, entry in out]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"two sequences have the name {name!r}; give each a name of its own")
    return tuple(out)


def place_of(entry: Entry) -> str | None:
    """Absolute path of a recording, None if synthetic."""
    return None if entry.path is None else str(entry.path.resolve())


def _real(table: dict[str, Any], folder: Path) -> tuple[str, int, Entry]:
    given = checked(RealTable, table, "a sequence")
    path = folder / Path(given.path).expanduser()
    name = given.name or path.resolve().name
    return name, 0, Entry(name, path, max_frames=given.frames)


def _synthetic(table: dict[str, Any]) -> list[tuple[str, int, Entry]]:
    from dudmap.lab.synthetic import sequence

    given, known = checked(SyntheticTable, table, "a synthetic sequence"), set(inspect.signature(sequence).parameters)
    for key in table:
        if key not in known | {"name", "replicates"}:
            raise ConfigError(f"a synthetic sequence has no parameter {key!r}; known are {', '.join(sorted(known))}")
    name = given.name or given.scene
    first = Entry(name, parameters={key: value for key, value in table.items() if key in known})
    entries = [_with_seed(first, given.seed + n) for n in range(given.replicates)]
    return [(name, n, entry if given.replicates > 1 else replace(entry, name=name)) for n, entry in enumerate(entries)]


def _with_seed(entry: Entry, seed: int) -> Entry:
    base = entry.name.rpartition("#")[0] or entry.name
    return replace(entry, name=f"{base}#{seed}", parameters={**entry.parameters, "seed": seed})
