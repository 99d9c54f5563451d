"""Every parameter once: unit, default, meaning.

The tree is frozen, unknown keys are errors, and it reads and writes TOML. Keys are dotted by part:
``volume.voxel_size``, ``tracker.huber``, ``dynamics.method``.
"""

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, overload

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dudmap.errors import ConfigError

Scalar = TypeVar("Scalar", bound=np.floating)


class Part(BaseModel):
    """Base of all parts: frozen, strict about unknown keys, documented by the strings under the fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


class SensorConfig(Part):
    """Noise of the depth sensor: sigma(z) = sigma_base + sigma_scale z^2 (thesis eq. 3.91)."""

    sigma_base: float = Field(default=0.001, ge=0, le=0.1)
    """Standard deviation at the lens, metres."""
    sigma_scale: float = Field(default=0.0019, ge=0, le=0.1)
    """Growth of the standard deviation with the square of the depth, 1/m."""

    @overload
    def sigma(self, z: float) -> float: ...
    @overload
    def sigma(self, z: NDArray[Scalar]) -> NDArray[Scalar]: ...
    def sigma(self, z: Any) -> Any:
        """Standard deviation of a depth reading at depth ``z``, metres; it has the shape and precision of ``z``."""
        return self.sigma_base + self.sigma_scale * z**2


class PreprocessConfig(Part):
    """Depth limits, hole filling and smoothing (thesis section 4.3)."""

    depth_min: float = Field(default=0.2, ge=0)
    """Readings nearer than this are ignored, metres."""
    depth_max: float = Field(default=6.0, gt=0)
    """Readings farther than this are ignored, metres."""
    fill_holes: bool = True
    """Give pixels without a reading the mean of their 5x5 neighbours where those lie on one surface."""
    filter: Literal["bilateral", "none"] = "bilateral"
    """Depth-adaptive bilateral filter (eq. 4.8-4.11) or none."""
    filter_alpha: float = Field(default=0.012, gt=0)
    """sigma_c = filter_alpha z^2, 1/m (the thesis' 12 is in millimetres at one metre)."""
    filter_sigma_px: float = Field(default=4.0, gt=0)
    """Spatial standard deviation sigma_s, pixels."""
    filter_radius: int = Field(default=6, ge=1, le=16)
    """Half width of the filter window, pixels."""

    @model_validator(mode="after")
    def _ordered(self) -> "PreprocessConfig":
        if self.depth_min >= self.depth_max:
            raise ValueError(f"depth_min {self.depth_min} must be smaller than depth_max {self.depth_max}")
        return self


class SimilarityConfig(Part):
    """Redundant-view test (thesis section 4.3)."""

    enabled: bool = True
    """Leave frames out of the fusion that show what the last fused one showed; they still get a pose."""
    threshold: float = Field(default=0.84, gt=0, le=1)
    """Share of SIFT features of the last fused frame found again above which a view is redundant."""
    ratio: float = Field(default=0.7, gt=0, lt=1)
    """Lowe's ratio test: best over second best descriptor distance."""
    image_width: int = Field(default=320, ge=80)
    """Width of the image the features are found in, pixels."""
    max_features: int = Field(default=500, ge=50)
    """Most features a frame may have."""
    max_translation: float = Field(default=0.005, ge=0)
    """A camera that moved more than this since the last fused frame is not tested, metres; 0 tests all frames."""
    max_rotation_deg: float = Field(default=0.3, ge=0)
    """A camera that turned more than this since the last fused frame is not tested, degrees."""
    patience: int = Field(default=5, ge=0)
    """Frames that are fused untested after a test that found nothing redundant: the test costs as much as the rest.
    Twice, then four, then eight times as many where the next ones find nothing either."""


class VolumeConfig(Part):
    """Voxel-hashed truncated signed distance field (thesis section 4.5)."""

    voxel_size: float = Field(default=0.01, gt=0, le=1)
    """Edge of a voxel, metres."""
    truncation_voxels: float = Field(default=4.0, ge=1, le=64)
    """Band in front of a surface that is stored, voxels; grows with the sensor's noise."""
    truncation_behind_voxels: float = Field(default=4.0, ge=1, le=64)
    """Band behind a surface that is stored, voxels."""
    truncation_noise: float = Field(default=3.0, ge=0)
    """The band is at least this many standard deviations of the depth reading wide; 0 keeps it fixed."""
    take_turns: bool = True
    """Fuse into a block only in every second frame, with double weight, where the noise is coarser than the voxels."""
    max_weight: int = Field(default=255, ge=1, le=255)
    """Cap of the running average (eq. 4.19)."""
    max_readings: int = Field(default=48, ge=1, le=255)
    """A reading adds to the average up to the weight of so many like it: poor ones give way soon to better ones."""
    weighting: Literal["constant", "angle"] = "angle"
    """Weight of one observation: 1, or cos(theta) / err(z) (eq. 4.20)."""
    min_weight: int = Field(default=3, ge=1, le=255)
    """Observations a voxel needs before the mesh and the views trust it."""
    carving: bool = True
    """Remove what is seen to be empty (thesis section 7.1)."""
    carve_rate: int = Field(default=4, ge=1, le=64)
    """Weight of an observation of emptiness in a voxel that holds a surface."""
    free_after: int = Field(default=4, ge=1, le=200)
    """Frames a block must be seen empty before it counts as free space."""

    @model_validator(mode="after")
    def _reachable(self) -> "VolumeConfig":
        if self.min_weight > min(self.max_weight, self.max_readings):
            raise ValueError(
                f"min_weight {self.min_weight} must not exceed max_weight {self.max_weight} and max_readings "
                f"{self.max_readings}: no voxel would ever be trusted"
            )
        return self


class TrackerConfig(Part):
    """Direct SDF and intensity registration (thesis section 4.4)."""

    robust: Literal["huber", "tukey"] = "huber"
    """Weight function (eq. 4.44, 4.45)."""
    huber: float = Field(default=0.01, gt=0)
    """Huber constant of the distance residual, metres at one metre depth."""
    tukey: float = Field(default=0.05, gt=0)
    """Tukey constant of the distance residual, metres at one metre depth."""
    damping: float = Field(default=0.02, gt=0)
    """First Levenberg-Marquardt damping, relative to the diagonal of J^T J (eq. 4.42)."""
    color_weight: float = Field(default=0.1325, ge=0)
    """Weight of the squared intensity residual (0..1) against the squared distance residual (m), eq. 4.32."""
    color_huber: float = Field(default=0.07, gt=0)
    """Huber constant of the intensity residual."""
    exposure: bool = True
    """Fit gain and offset of the image's intensities to the map's before each level."""
    noise_weighting: bool = True
    """Weight each distance residual by the sensor's noise at its depth."""
    iterations: tuple[int, ...] = (8, 6, 3)
    """Most iterations per level, coarse to fine; 0 leaves the level out."""
    widths: tuple[int, ...] = (80, 160, 320)
    """Image width per level, coarse to fine, pixels; the nearest halving of the camera's image is taken."""
    stop: float = Field(default=5e-4, gt=0)
    """A level ends when the step's norm falls below this."""
    stop_gain: float = Field(default=3e-3, ge=0, lt=1)
    """A level also ends when a short step changes the cost by less than this share; 0 turns it off."""
    second_pass: bool = True
    """Register again with the dynamic labels (algorithm 4)."""
    constant_velocity: bool = True
    """Start from the motion of the last frame."""
    min_inliers: float = Field(default=0.15, ge=0, le=1)
    """Share of the readings that must fall on the map for a frame to count as tracked."""
    max_residual: float = Field(default=4.0, gt=0)
    """Largest median residual of a tracked frame, in standard deviations of the reading."""
    min_condition: float = Field(default=1e-4, ge=0, lt=1)
    """Smallest ratio of the extreme eigenvalues of the scaled J^T J of a tracked frame."""
    max_speed: float = Field(default=5.0, gt=0)
    """Fastest believable camera, m/s."""
    max_turn_deg: float = Field(default=360.0, gt=0)
    """Fastest believable turn, degrees per second."""

    @model_validator(mode="after")
    def _levels(self) -> "TrackerConfig":
        if len(self.iterations) != len(self.widths) or not self.widths:
            raise ValueError("iterations and widths need one entry per level each")
        if min(self.widths) < 16 or list(self.widths) != sorted(set(self.widths)):
            raise ValueError(f"widths must grow and be at least 16, found {self.widths}")
        if sum(self.iterations) <= 0 or min(self.iterations) < 0:
            raise ValueError("iterations must hold at least one positive number and none below 0")
        return self


class DynamicsConfig(Part):
    """Which pixels move (thesis section 4.6)."""

    method: Literal["em", "threshold", "none"] = "em"
    """EM on the residuals, the threshold-and-flood rule of the ancestor, or no dynamic handling."""
    free_space: bool = True
    """Points that appear in space the map knows to be free are dynamic (EM only)."""
    regions: bool = True
    """Decide per depth-connected region, not per pixel (EM only)."""
    width: int = Field(default=160, ge=40, le=1280)
    """Width of the label image, pixels; the nearest halving of the camera's image is taken."""
    threshold: float = Field(default=0.07, gt=0)
    """Distance to the map from which on the threshold rule calls a reading moving, metres (10 cm / sqrt 2 in the
    ancestor's published code); with a stored band narrower than that, the rim of the band."""
    noise_threshold: float = Field(default=0.03, gt=0)
    """Smallest distance to the static map that may be called motion, metres (theta in eq. 4.57)."""
    noise_sigmas: float = Field(default=3.0, ge=0)
    """The same in standard deviations of the reading; the larger of both counts."""
    pieces: bool = True
    """Decide for whole pieces of surface, and remember what moved until it has settled (with regions only)."""
    settle_time: float = Field(default=1.5, gt=0, le=60)
    """What moved and has stood still for this long is no longer called moving, and becomes map, seconds."""
    max_share: float = Field(default=0.9, gt=0, le=1)
    """A frame of whose readings more than this share seems to move is not believed, but reported as lost."""
    start_seconds: float = Field(default=1.0, ge=0)
    """Time from the first frame on in which movers are also found from image to image (parallax), since the map does
    not know free space yet; prolonged while that finds what the map does not. 0 turns it off. EM only."""
    margin_px: int = Field(default=5, ge=0, le=50)
    """Pixels around a moving region that are not fused either."""


class RelocalizationConfig(Part):
    """Finding a known place again after tracking was lost: keyframes, SIFT features, 3D-3D RANSAC."""

    enabled: bool = True
    """Remember keyframes, and try to recognise one of them in every lost frame."""
    keyframe_distance: float = Field(default=0.25, gt=0)
    """A keyframe is made where the camera is farther than this from all others, metres,"""
    keyframe_angle_deg: float = Field(default=15.0, gt=0)
    """or turned by more than this, degrees."""
    keyframe_gap: int = Field(default=10, ge=0)
    """Tracked frames between two keyframes at least."""
    max_keyframes: int = Field(default=200, ge=2)
    """Most keyframes that are kept; the one nearest to another goes first."""
    max_features: int = Field(default=400, ge=50)
    """Most features of a keyframe."""
    image_width: int = Field(default=320, ge=80)
    """Width of the image the features are found in, pixels."""
    ratio: float = Field(default=0.85, gt=0, lt=1)
    """Lowe's ratio test: best over second best descriptor distance."""
    min_inliers: int = Field(default=15, ge=4)
    """Matches that must agree on a pose."""
    min_share: float = Field(default=0.25, ge=0, le=1)
    """Share of all matches with the keyframe that must agree on it."""
    min_on_map: float = Field(default=0.4, ge=0, le=1)
    """Share of a frame's readings that must be static and fall on the map for the pose to be believed."""
    max_distance: float = Field(default=0.06, gt=0)
    """Farthest that the registration may move the pose of the features, metres,"""
    max_angle_deg: float = Field(default=3.0, gt=0)
    """or turn it, degrees."""


class LoopsConfig(Part):
    """Correcting the map when a known place is seen again after drift."""

    enabled: bool = True
    """Compare new views with places not seen for a while, and correct the trajectory and the map."""
    min_age: float = Field(default=5.0, gt=0)
    """A place counts as seen again if the camera has not been near for this long, seconds."""
    gap: int = Field(default=15, ge=1)
    """Frames between two attempts at least."""
    min_distance: float = Field(default=0.02, ge=0)
    """Smaller corrections than this, metres,"""
    min_angle_deg: float = Field(default=0.7, ge=0)
    """and than this, degrees, are noise: nothing is done."""
    max_drift: float = Field(default=0.1, gt=0)
    """Largest believable drift: share of the path since the place was last seen, a turn by one radian counting 1 m."""
    keep_distance: float = Field(default=0.08, gt=0)
    """A fused frame this far from the last kept one is kept on disk, metres,"""
    keep_angle_deg: float = Field(default=5.0, gt=0)
    """or turned by this, degrees,"""
    keep_gap: int = Field(default=15, ge=1)
    """or this many fused frames after it."""


class SubmapsConfig(Part):
    """Going on in a new map where the camera is lost and recognises nothing."""

    enabled: bool = True
    """Start a new submap after a while without a known place; join it with the others when one is recognised."""
    patience: float = Field(default=1.0, ge=0)
    """Time without a recognised place before a new submap is started, seconds."""
    min_readings: float = Field(default=0.2, ge=0, le=1)
    """Share of the pixels of its first frame that must have a reading."""


class MoversConfig(Part):
    """Moving bodies with identity and velocity, as a result; they never influence the pose."""

    enabled: bool = True
    """Report the bodies that move."""
    min_area: float = Field(default=0.015, ge=0)
    """Smallest visible surface of a body, square metres."""
    merge_distance: float = Field(default=0.3, ge=0)
    """A small region nearer than this to a larger one is a part of it, metres."""
    max_jump: float = Field(default=0.4, gt=0)
    """Farthest from where it was expected that a body is still the same, metres; overlapping boxes count too."""
    memory: float = Field(default=0.7, ge=0)
    """A body that comes back into view within this time keeps its number, seconds."""
    velocity_window: float = Field(default=0.2, gt=0)
    """The velocity is the mean over this time, seconds."""
    meshes: bool = False
    """Also fuse each rigid body into a mesh of its own and follow its pose (movers/<id>.ply and .txt of a run)."""
    mesh_voxel_size: float = Field(default=0.005, ge=0.004, le=0.1)
    """Edge of a voxel of these meshes, metres."""


class Config(Part):
    """All parameters of the system."""

    preset: Literal["default", "thesis"] = "default"
    """The values that all others start from."""
    sensor: SensorConfig = SensorConfig()
    preprocess: PreprocessConfig = PreprocessConfig()
    similarity: SimilarityConfig = SimilarityConfig()
    volume: VolumeConfig = VolumeConfig()
    tracker: TrackerConfig = TrackerConfig()
    dynamics: DynamicsConfig = DynamicsConfig()
    relocalization: RelocalizationConfig = RelocalizationConfig()
    loops: LoopsConfig = LoopsConfig()
    submaps: SubmapsConfig = SubmapsConfig()
    movers: MoversConfig = MoversConfig()

    @classmethod
    def load(cls, path: str | Path) -> "Config":
        """Read a TOML file; what it leaves out keeps its preset's value.

        Raises:
            ConfigError: The file is missing, not TOML, or holds an unknown key or a value out of range.
        """
        try:
            tree = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"cannot read the configuration {path}: {error}") from error
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"the configuration {path} is not valid TOML: {error}") from error
        return cls.from_tree(tree)

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> "Config":
        """Configuration from nested dictionaries over the values of the preset they name."""
        _check_keys(tree)
        preset = tree.get("preset", "default")
        if preset not in PRESETS:
            raise ConfigError(f"unknown preset {preset!r}; expected one of {', '.join(PRESETS)}")
        try:
            return cls.model_validate(_merged(PRESETS[preset], tree))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"]) or "configuration"
            raise ConfigError(f"{key} = {first['input']!r} is not acceptable: {first['msg']}") from None

    def override(self, assignments: Iterable[str]) -> "Config":
        """Configuration with ``key=value`` assignments applied, e.g. ``tracker.huber=0.02``; values are TOML or words.

        Assigning ``preset`` starts anew from that preset's values.
        """
        tree: dict[str, Any] = {}
        for assignment in assignments:
            key, equals, text = assignment.partition("=")
            if not equals:
                raise ConfigError(f"cannot understand {assignment!r}; expected key=value, e.g. tracker.huber=0.02")
            parts = key.strip().split(".")
            branch = tree
            for part in parts[:-1]:
                branch = branch.setdefault(part, {})
                if not isinstance(branch, dict):
                    raise ConfigError(f"{key.strip()} is not a key: {part} holds a value")
            branch[parts[-1]] = _value(text.strip())
        base = {} if "preset" in tree else self.model_dump()
        _check_keys(tree)
        return self.from_tree(_merged(base, tree))

    def to_toml(self) -> str:
        """TOML text with every value."""
        lines = [f'preset = "{self.preset}"']
        for part, values in self.model_dump().items():
            if isinstance(values, dict):
                lines += ["", f"[{part}]"]
                lines += [f"{key} = {_toml(value)}" for key, value in values.items()]
        return "\n".join(lines) + "\n"

    def save(self, path: str | Path) -> None:
        """Write every value as TOML."""
        Path(path).write_text(self.to_toml(), encoding="utf-8")


PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "thesis": {
        "volume": {
            "voxel_size": 0.01,
            "truncation_noise": 0.0,
            "max_readings": 255,
            "weighting": "constant",
            "take_turns": False,
        },
        "tracker": {
            "huber": 0.01,
            "damping": 0.02,
            "color_weight": 0.1325,
            "color_huber": 0.1,
            "noise_weighting": False,
            "exposure": False,
            "stop": 1e-3,
            "stop_gain": 0.0,
        },
        "similarity": {"threshold": 0.84, "patience": 0},
        "preprocess": {"filter_alpha": 0.012, "filter_sigma_px": 4.0},
        "dynamics": {"method": "em", "free_space": False, "regions": False, "start_seconds": 0.0},
        "relocalization": {"enabled": False},
        "loops": {"enabled": False},
        "submaps": {"enabled": False},
        "movers": {"enabled": False},
    },
}


def keys() -> list[str]:
    """Every dotted key."""
    out = ["preset"]
    for part, field in Config.model_fields.items():
        if isinstance(field.default, Part):
            out += [f"{part}.{key}" for key in type(field.default).model_fields]
    return out


def _check_keys(tree: Mapping[str, Any]) -> None:
    known = keys()
    for part, values in tree.items():
        found = [f"{part}.{key}" for key in values] if isinstance(values, Mapping) else [part]
        for key in found:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
                raise ConfigError(f"unknown configuration key {key!r}; the nearest known key is {near[0]!r}")


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in over.items():
        old = out.get(key)
        out[key] = _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def _value(text: str) -> Any:  # noqa: ANN401 - TOML values have many types
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _toml(value: Any) -> str:  # noqa: ANN401
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value)
