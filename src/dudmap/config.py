"""All parameters with their defaults, bounds, units and meanings.

The configuration is immutable, rejects unknown keys, and reads and writes TOML. Dotted keys name section and
parameter: ``volume.voxel_size``, ``tracker.huber``, ``dynamics.enabled``. A default without a stated source was tuned
on the recordings of docs/benchmarks.md.
"""

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import tomli_w
from pydantic import Field, model_validator

from dudmap.atomic_file import write_text
from dudmap.config_section import ConfigSection, check_key
from dudmap.errors import ConfigError
from dudmap.gone_keys import without_gone
from dudmap.input_files import describe, parse_toml, read_toml
from dudmap.ranges import RANGES, scaled
from dudmap.thesis_config import ThesisConfig


def reading_sigma(z: Any, base: Any, scale: Any) -> Any:  # noqa: ANN401 - numbers or arrays
    """Standard deviation of a measurement at depth ``z``, metres (thesis eq. 3.91); the kernels compile this text."""
    return base + scale * (z * z)


class SensorConfig(ConfigSection):
    """Noise model of the depth sensor: sigma(z) = sigma_base + sigma_scale z^2 (thesis eq. 3.91)."""

    sigma_base: float = Field(default=0.001, ge=0, le=0.1)
    """Standard deviation at depth zero, metres."""
    sigma_scale: float = Field(default=0.0019, ge=0, le=0.1)
    """Growth of the standard deviation with the square of the depth, 1/m; the default is the
    coefficient that Nguyen et al. (2012) measured on a Kinect."""
    reference_depth: float = Field(default=1.0, ge=0.1, le=10)
    """Depth at which distance thresholds are given, metres, and unit of constant lengths: 1 for rooms.
    ``Config.for_range`` scales it with all other lengths."""
    color_time_sigma: float = Field(default=0.009, ge=0, le=0.1)
    """Standard deviation of the time between colour and depth of a pixel, seconds; 0 for synchronous global shutters.
    The default is a rolling shutter with 30 ms readout (30 ms / sqrt 12). An estimated timing brings its own."""

    self_calibration: bool = True
    """Calibrate the colour camera against the depth camera during the run, unless a given calibration was estimated.
    The result repaints the map. Needs the stored frames of loop closing or submaps."""

    @property
    def reference_sigma(self) -> float:
        """Standard deviation at ``reference_depth``, metres."""
        return float(self.sigma(self.reference_depth))

    def sigma(self, z: Any) -> Any:  # noqa: ANN401 - a number or an array
        """Standard deviation, metres, at depth ``z`` in metres (a number or an array)."""
        return reading_sigma(z, self.sigma_base, self.sigma_scale)


class PreprocessConfig(ConfigSection):
    """Depth range, hole filling and smoothing of the depth image (thesis section 4.3)."""

    depth_min: float = Field(default=0.2, ge=0)
    """Smallest valid depth, metres."""
    depth_max: float = Field(default=6.0, gt=0)
    """Largest valid depth, metres."""
    drop_mixed: bool = False
    """Drop depth between foreground and background at depth edges (flying pixels)."""
    fill_holes: bool = True
    """Fill pixels without depth with the mean of their 5x5 neighbours on one surface."""
    filter: Literal["bilateral", "none"] = "bilateral"
    """Depth-adaptive bilateral filter (thesis eq. 4.8-4.11) or no filter."""
    filter_sigma_px: float = Field(default=4.0, gt=0)
    """Spatial standard deviation sigma_s, pixels (thesis section 4.3)."""
    filter_radius: int = Field(default=6, ge=1, le=16)
    """Radius of the filter window, pixels."""

    @property
    def smoothing_px(self) -> float:
        """Spatial standard deviation of the filter in use, pixels; 0 without."""
        return self.filter_sigma_px if self.filter == "bilateral" else 0.0

    @model_validator(mode="after")
    def _ordered(self) -> "PreprocessConfig":
        if self.depth_min >= self.depth_max:
            raise ValueError(f"depth_min {self.depth_min} must be smaller than depth_max {self.depth_max}")
        return self


class SimilarityConfig(ConfigSection):
    """Detection of redundant views, which are not fused (thesis section 4.3)."""

    enabled: bool = True
    """Do not fuse frames whose view the map already contains; they are still tracked."""
    threshold: float = Field(default=0.84, gt=0, le=1)
    """Share of the view known to the map by its weights above which it is redundant (thesis section 4.3)."""
    max_translation: float = Field(default=0.005, ge=0)
    """Translation since the last fused frame above which a view counts as new without the test, metres; 0 tests all."""


class VolumeConfig(ConfigSection):
    """Voxel-hashed truncated signed distance field (thesis section 4.5)."""

    voxel_size: float = Field(default=0.01, gt=0, le=1)
    """Edge length of a voxel, metres."""
    truncation_voxels: float = Field(default=4.0, ge=1, le=64)
    """Truncation distance in front of a surface, voxels; grows with the noise, see ``truncation_noise``."""
    truncation_behind_voxels: float = Field(default=4.0, ge=1, le=64)
    """Truncation distance behind a surface, voxels."""
    truncation_noise: float = Field(default=3.0, ge=0)
    """Smallest truncation distance in standard deviations of the depth measurement; 0 keeps it fixed."""
    take_turns: bool = True
    """Integrate into a block only every second frame, with double weight, if the noise exceeds the voxel size."""
    max_weight: int = Field(default=255, ge=1, le=255)
    """Largest weight of the running average (thesis eq. 4.19)."""
    max_readings: int = Field(default=48, ge=1, le=255)
    """Largest weight of a voxel that a measurement can reach, in multiples of its own. Measurements of low weight so
    lose influence once better ones arrive."""
    weighting: Literal["constant", "angle"] = "angle"
    """Weight of an observation: 1 (constant) or cos(theta) / err(z) (angle; thesis eq. 4.20)."""
    min_weight: int = Field(default=3, ge=1, le=255)
    """Smallest weight of a voxel that the mesh and rendered views use."""
    carving: bool = True
    """Remove surfaces that are observed to be free space (thesis section 7.1)."""
    carve_rate: int = Field(default=4, ge=1, le=64)
    """Weight of a free-space observation in a voxel that holds a surface."""
    free_after: int = Field(default=4, ge=1, le=200)
    """Number of free-space observations after which a block counts as free space."""
    adaptive: bool = False
    """Halve voxels on curved or finely coloured surfaces that the sensor resolves (thesis section 7.1)."""
    adaptive_levels: int = Field(default=1, ge=1, le=2)
    """Most halvings of the voxel size: one or two (adaptive only)."""
    adaptive_bend: float = Field(default=0.4, gt=0)
    """Smallest curvature times voxel size at which voxels are halved (adaptive only): 0.4 is a radius of 2.5 voxels."""

    @model_validator(mode="after")
    def _reachable(self) -> "VolumeConfig":
        if self.min_weight > min(self.max_weight, self.max_readings):
            raise ValueError(
                f"min_weight {self.min_weight} must not exceed max_weight {self.max_weight} and max_readings "
                f"{self.max_readings}: no voxel would ever be trusted"
            )
        return self


class TrackerConfig(ConfigSection):
    """Direct registration to the TSDF by distance and intensity residuals (thesis section 4.4)."""

    huber: float = Field(default=0.01, gt=0)
    """Huber threshold of the distance residual, metres at the reference depth (thesis eq. 4.44, table 6.1)."""
    color_weight: float = Field(default=0.1325, ge=0)
    """Weight of the squared intensity residual (0..1) relative to the squared distance residual (metres); thesis eq.
    4.32, table 6.2."""
    exposure: bool = True
    """Fit gain and offset between image and map intensities on the coarsest pyramid level."""
    iterations: tuple[int, ...] = (8, 6, 6)
    """Largest number of iterations per pyramid level, coarse to fine; 0 skips the level."""
    widths: tuple[int, ...] = (80, 160, 320)
    """Image width per pyramid level, coarse to fine, pixels; rounded to a halving of the camera image."""
    max_speed: float = Field(default=5.0, gt=0)
    """Largest plausible speed of the camera, m/s."""
    max_turn_deg: float = Field(default=360.0, gt=0)
    """Largest plausible rotation rate of the camera, degrees per second."""

    @model_validator(mode="after")
    def _levels(self) -> "TrackerConfig":
        if len(self.iterations) != len(self.widths) or not self.widths:
            raise ValueError("iterations and widths need one entry per level each")
        if min(self.widths) < 16 or list(self.widths) != sorted(set(self.widths)):
            raise ValueError(f"widths must grow and be at least 16, found {self.widths}")
        if sum(self.iterations) <= 0 or min(self.iterations) < 0:
            raise ValueError("iterations must hold at least one positive number and none below 0")
        return self


class DynamicsConfig(ConfigSection):
    """Detection of dynamic pixels (thesis section 4.6)."""

    enabled: bool = True
    """Detect dynamic pixels; otherwise every pixel is static."""
    width: int = Field(default=160, ge=40, le=1280)
    """Width of the label image, pixels; rounded to a halving of the camera image."""
    settle_time: float = Field(default=1.5, gt=0, le=60)
    """Time at rest after which an object is static again and fused, seconds."""
    start_seconds: float = Field(default=1.0, ge=0)
    """Time after the first frame in which motion between images also detects objects, seconds, because the map has no
    free space yet. It is extended while this finds objects; 0 disables it."""
    margin_px: int = Field(default=5, ge=0, le=50)
    """Margin around dynamic regions that is not fused, pixels of an image 640 wide."""


class RelocalizationConfig(ConfigSection):
    """Relocalisation after tracking was lost: keyframes, SIFT features, 3D-3D RANSAC."""

    enabled: bool = True
    """Store keyframes, and match every lost frame against them."""
    keyframe_distance: float = Field(default=0.25, gt=0)
    """A frame becomes a keyframe if it is farther than this from all other keyframes, metres,"""
    keyframe_angle_deg: float = Field(default=15.0, gt=0)
    """or rotated by more than this, degrees."""
    keyframe_gap: int = Field(default=10, ge=0)
    """Smallest number of tracked frames between two keyframes."""
    max_keyframes: int = Field(default=200, ge=2)
    """Largest number of keyframes; the one nearest to another is removed first."""


class LoopsConfig(ConfigSection):
    """Loop closing: correction of trajectory and map when a known place is seen again."""

    enabled: bool = True
    """Detect and close loops."""
    min_age: float = Field(default=5.0, gt=0)
    """Smallest time since the camera was last near a place that closes a loop, seconds."""
    gap: int = Field(default=15, ge=1)
    """Smallest number of frames between two attempts."""
    keep_distance: float = Field(default=0.08, gt=0)
    """A fused frame is stored on disk if it is this far from the last stored one, metres, or rotated by 5 degrees,"""
    keep_gap: int = Field(default=15, ge=1)
    """or this many fused frames after it."""


class SubmapsConfig(ConfigSection):
    """Submaps: a camera that is lost and cannot be relocalised starts a new map."""

    enabled: bool = True
    """Start a new submap when relocalisation fails, and merge it when a known place is recognised."""
    patience: float = Field(default=1.0, ge=0)
    """Time since tracking was lost before a new submap is started, seconds."""


class MoversConfig(ConfigSection):
    """Tracking of moving objects; it does not influence the camera pose."""

    enabled: bool = True
    """Track moving objects and report their identity and velocity."""
    min_area: float = Field(default=0.015, ge=0)
    """Smallest visible surface area of an object, square metres."""
    meshes: bool = False
    """Reconstruct each rigid object and estimate its pose (movers/<id>.ply and .txt of a run)."""
    mesh_voxel_size: float = Field(default=0.005, ge=0.001, le=0.1)
    """Edge length of the voxels of these objects, metres."""


class Config(ConfigSection):
    """All parameters."""

    system: Literal["dudmap", "thesis"] = "dudmap"
    """System that processes the frames: ``dudmap``, or ``thesis``, the thesis as written, which uses only the section
    ``thesis``."""
    device: str = Field(default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?|warp-cpu)$")
    """Device: cpu, cuda, cuda:1 for the second GPU (extra gpu), or auto, a working GPU if ``volume.adaptive`` is off.
    warp-cpu runs the GPU kernels slowly on the CPU, for tests."""
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
    thesis: ThesisConfig = ThesisConfig()

    def __init__(self, **values: Any) -> None:  # noqa: ANN401 - sections, mappings and values alike
        """Parameters by section: ``Config(volume={"voxel_size": 0.02})``.

        Raises:
            ConfigError: A key is unknown or a value invalid.
        """
        tree = {key: value.model_dump() if isinstance(value, ConfigSection) else value for key, value in values.items()}
        tree = without_gone(tree)
        _check_keys(tree)
        super().__init__(**tree)

    @classmethod
    def for_range(cls, name: str) -> "Config":
        """The defaults for a ``near`` (0.1 to 0.5 m), ``room`` or ``far`` (6 to 15 m) scene, see ``dudmap.ranges``.

        Raises:
            ConfigError: There is no such range.
        """
        if name not in RANGES:
            raise ConfigError(f"found the range {name!r}; expected one of {', '.join(RANGES)}")
        return cls.from_tree({}, RANGES[name])

    @classmethod
    def load(cls, path: str | Path, size: float = 1.0) -> "Config":
        """Load a TOML file; other parameters keep the defaults of a scene of ``size`` rooms.

        Raises:
            ConfigError: The file is missing, not TOML, or holds an unknown key or an invalid value.
        """
        try:
            tree = read_toml(path)
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"cannot read the configuration {path}: {describe(error)}") from error
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"the configuration {path} is not valid TOML: {error}") from error
        return cls.from_tree(tree, size)

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any], size: float = 1.0) -> "Config":
        """Configuration from nested dictionaries, as ``load``.

        Raises:
            ConfigError: A key is unknown or a value invalid.
        """
        tree = without_gone(tree)
        _check_keys(tree)
        return cls(**_merged(scaled(cls().model_dump(), size), tree))

    def override(self, assignments: Iterable[str]) -> "Config":
        """Configuration with assignments ``key=value``, e.g. ``tracker.huber=0.02``; values are TOML or plain words.

        Raises:
            ConfigError: An assignment is malformed, its key unknown or its value invalid.
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
        known = without_gone(tree)
        _check_keys(known)
        return Config(**_merged(self.model_dump(), known))

    def check_used(self) -> None:
        """Refuse changed parameters that ``system`` does not have.

        Raises:
            ConfigError: It names such a parameter.
        """
        used, default = self.system == "thesis", Config()
        for key in keys():
            section, _, name = key.partition(".")
            foreign = bool(name) and (section == "thesis") != used
            if foreign and getattr(getattr(self, section), name) != getattr(getattr(default, section), name):
                other = "dudmap" if used else "thesis"
                raise ConfigError(
                    f"the system {self.system} has no parameter {key}; leave it out, or choose --system {other}"
                )

    @property
    def depth_limits(self) -> tuple[float, float]:
        """Smallest and largest depth that the system uses, metres."""
        part = self.thesis if self.system == "thesis" else self.preprocess
        return part.depth_min, part.depth_max

    @property
    def range_text(self) -> str:
        """Sentence part on voxels and depth range."""
        least, largest = self.depth_limits
        return f"voxels of {1000 * self.volume.voxel_size:g} mm, depth from {least:g} to {largest:g} m"

    def to_toml(self) -> str:
        """TOML text of all values."""
        return tomli_w.dumps(self.model_dump())

    def save(self, path: str | Path) -> None:
        """Write all values as TOML."""
        write_text(path, self.to_toml())


def keys() -> list[str]:
    """All dotted keys."""
    out = ["system", "device"]
    for part, field in Config.model_fields.items():
        if isinstance(field.default, ConfigSection):
            out += [f"{part}.{key}" for key in type(field.default).model_fields]
    return out


def _check_keys(tree: Mapping[str, Any]) -> None:
    known = keys()
    for part, values in tree.items():
        found = [f"{part}.{key}" for key in values] if isinstance(values, Mapping) else [part]
        for key in found:
            check_key(key, known)


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in over.items():
        old = out.get(key)
        out[key] = _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def _value(text: str) -> Any:  # noqa: ANN401 - TOML values have many types
    try:
        return parse_toml(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
