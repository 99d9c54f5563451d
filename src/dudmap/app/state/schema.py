"""What a stored state may hold: the classes of its objects, and for each of them the names and types of its attributes.

A state is data. Its classes are the table ``CLASSES``; attributes of a dataclass are its fields with their annotations,
those of another class what its methods name, of the types that they have in a new object of the class.
"""

import sys
from collections import ChainMap, deque
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import cache, cached_property
from importlib import import_module
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

CLASSES = """
app.pipeline.metrics:RunRecord app.pipeline.storing:RunState
config:ConfigSection,SensorConfig,PreprocessConfig,SimilarityConfig,VolumeConfig,TrackerConfig,DynamicsConfig,RelocalizationConfig,LoopsConfig,SubmapsConfig,MoversConfig,Config
core.backends.cpu.consensus:ConsensusParams,Correspondences
core.backends.cpu.evidence:NoiseParameters,MixtureRules,RegionRules
core.backends.cpu.reprojection:Reprojection core.backends.cpu.segment_motion:SegmentImage
core.backends.cpu.splatting:PointImage core.backends.descent:DescentRules,Descent core.backends.mirror:Mirror
core.backends.parameters:SensorNoise,TruncationBand,FusionParameters,RegistrationParameters,ColorProjection,RaycastParameters,MeshParameters,FilterParameters,VoxelGrid,DepthTiles,DepthView,FreeSpace,TouchedBlocks,FusedBlocks,NormalEquations,MapSample,RaycastResult
core.calibration.adjustment:Fit,_PairSystems,_System,Adjustment
core.calibration.estimator:Estimate,_Trial,CalibrationEstimator
core.calibration.keyframes:ColorKeyframe,KeyframeCollector core.calibration.pairs:Pair,PairSet
core.calibration.self_calibration:SelfCalibration core.color_calibration:ColorCalibration
core.dynamics.background_model:BackgroundModel
core.dynamics.detector:_Comparison,DynamicDetector core.dynamics.dominant_motion:LabelledCorners,DominantMotion
core.dynamics.ego_motion:OlderImage,SlowMotion,EgoMotionSegmenter core.dynamics.masks:Labels,Mixture
core.dynamics.segments:Segmentation
core.dynamics.temporal_memory:RememberedFrame,TemporalMemory
core.frames.frame:FrameArrays,Frame core.frames.observation:Observation,Level core.frames.preprocess:Preprocessor
core.frames.pyramid:Pyramid core.frames.stream_check:Rejection,StreamCheck
core.geometry.association:TimedFile core.geometry.calibration:Calibration core.geometry.camera:Camera
core.geometry.lens:Lens,OtherView core.geometry.mesh:Mesh core.geometry.trajectory:Trajectory
core.map.adaptive_volume:AdaptiveVolume core.map.block_pager:BlockPager
core.map.block_window:BlockWindow core.map.fine_blocks:FineBlocks,BlockTree core.map.incremental_mesh:IncrementalMesh
core.map.memory_limit:MemoryLimit
core.map.paged_map:PagedMap
core.map.volume:TsdfVolume core.map.volume_mirror:VolumeMirror core.map.voxel_blocks:BlockRecords,VoxelBlocks
core.mapper:StartFrame,Bootstrap,Mapper
core.objects.moving_objects:_Frame,MovingObjects core.objects.object_fusion:ObjectView,ObjectFusion
core.objects.object_map:RigidObject,ObjectVolume,ObjectTrack
core.objects.object_tracker:Mover,_Measurement,_Track,ObjectTracker
core.objects.regions:MovingPixels,Region core.objects.scene_flow:InstanceFrame core.places.atlas:TimedPose,Atlas
core.places.features:ImageFeatures,SiftExtractor
core.places.frame_store:StoredFrame,FrameStore core.places.frame_thinning:FrameThinning
core.places.loop_closing:LoopSearch,LoopCloser
core.places.loop_correction:LoopCorrector core.places.loop_verification:LoopQuery,LoopVerifier
core.places.map_rebuilding:MapRebuilding
core.places.place_recognition:PlacedFeatures,Keyframe,PlaceMatch,KeyframeDatabase core.places.pose_graph:Edge
core.places.redundancy:SimilarityTest,_Place,RedundantViews
core.places.relocalizer:Relocalization,Relocalizer core.places.saved_map:SavedMap,PriorMap core.result:FrameResult
core.slam:Slam core.tracking.color_motion:RegisteredLevel,ColorMotion
core.tracking.estimate:PoseEstimate core.tracking.frame_view:StageTimer,FrameView
core.tracking.front_end:FrontEnd core.tracking.gradient_agreement:GradientAgreement
core.tracking.motion_model:MotionModel
core.tracking.observability:Observability,GradientNoise core.tracking.pose_prediction:PosePrediction,PosePredictor
core.tracking.quality_monitor:ImageComparison,ImageConsistency,RegistrationHistory,Verdict,QualityMonitor
core.tracking.tracker:TrackingResult,Minimum,Tracker
"""
"""All classes whose objects may be stored, and made from what is stored: modules of this package and names in them."""
NOT_STORED: dict[str, dict[str, Any]] = {
    "Atlas": {"make_volume": ...},
    "BlockPager": {"_store": None} | dict.fromkeys(("_away", "_returned", "_archived", "_archive"), ...),
    "FrameStore": {
        "registered": None,
        "_first_own": 0,
        "_file": None,
        "_encoder": None,
        "_pending": deque,
        "archived": ...,
    },
    "KeyframeDatabase": {"_sift": ...},
    "LoopCloser": {"_executor": None},
    "RunRecord": {"_since": (0.0, 0.0)},
    "Observation": {"_halvings": list, "_recorded_halvings": list},
    "SimilarityTest": {"_sift": ...},
    "Slam": {"device": ...},
    "TsdfVolume": dict.fromkeys(("blocks", "window", "levels", "map_id"), ...),
}
"""Attributes by class that a new object makes itself: connections, threads, files, what has a table of its own, what
follows from other attributes, and what is of one process or device alone. An object that is made without its
constructor gets the value, or what the class makes; ``...`` leaves it to what fills the object."""
BACKENDS = frozenset({"CpuBackend", "WarpBackend"})
"""Classes of back ends, which hold nothing that is part of the state: a new one may be of another device."""
EVALUATED = {"FrameView": ("segmentation",), "KeyframeDatabase": ("_unsettled",)}
"""Attributes that are functions without arguments, of which the result is stored."""
CONSTANT = frozenset({"PlacedFeatures", "Preprocessor"})
"""Classes whose arrays never change once they are made: they need not be copied for a snapshot."""
RECORDS = {"RunRecord": ("rows", "lost", "movers", "unreadable", "checks")}
"""Attributes that are lists of plain values which only grow; they are stored as lines of JSON."""
COLUMNS = frozenset({"TimedPose"})
"""Classes of which many objects stand in one list and nowhere else; they are stored attribute by attribute."""
NUMBERS = (bool, int, float, np.generic)
LARGEST_COUNT = 2**23
"""Largest number of equal things that are stored as one array."""


@cache
def _table() -> dict[str, str]:
    """Module by ``module:name``."""
    pairs = (entry.split(":") for entry in CLASSES.split())
    return {f"dudmap.{module}:{name}": f"dudmap.{module}" for module, names in pairs for name in names.split(",")}


def is_state_class(cls: type) -> bool:
    """Whether objects of a class may be stored and made from what is stored."""
    return name_of(cls) in _table()


def name_of(cls: type) -> str:
    """Name of a class in a stored state."""
    return f"{cls.__module__}:{cls.__qualname__}"


def class_of(name: object) -> type:
    """The class of a name; a ``ValueError`` if it is none whose objects are stored."""
    module = _table().get(name) if isinstance(name, str) else None
    if module is None:
        raise ValueError(f"found a {name!r}, which this version does not know")
    return getattr(import_module(module), str(name).partition(":")[2])


def not_stored(cls: type) -> set[str]:
    """Attributes that objects of a class make themselves."""
    return {name for base in cls.__mro__ for name in NOT_STORED.get(base.__name__, ())}


def defaults(cls: type) -> dict[str, Any]:
    """Values of these attributes in an object that is made without its constructor."""
    named = {name: value for base in cls.__mro__ for name, value in NOT_STORED.get(base.__name__, {}).items()}
    return {name: value() if callable(value) else value for name, value in named.items() if value is not ...}


def attributes(value: Any) -> dict[str, Any]:  # noqa: ANN401
    """The attributes of an object that are its state, in the order in which they were set.

    Values that ``functools.cached_property`` keeps are left out: they follow from the others.
    """
    left_out = not_stored(type(value))
    return {
        name: content
        for name, content in vars(value).items()
        if name not in left_out and not is_computed(type(value), name)
    }


def is_computed(cls: type, name: str) -> bool:
    """Whether an attribute is one that ``functools.cached_property`` keeps."""
    return isinstance(getattr(cls, name, None), cached_property)


@cache
def _names(cls: type) -> frozenset[str]:
    """Names that the attributes of an object may have."""
    if is_dataclass(cls):
        return frozenset(name for base in cls.__mro__ for name in vars(base).get("__annotations__", ()))
    codes = (getattr(one, "__code__", None) for base in cls.__mro__ for one in vars(base).values())
    return frozenset(name for code in codes if code is not None for name in code.co_names)


@cache
def _hints(cls: type) -> Mapping[str, Any]:
    """Annotations of a dataclass; the names that only type checkers import are those of the table."""
    known = {name.partition(":")[2]: class_of(name) for name in _table()}
    try:
        return get_type_hints(cls, localns=ChainMap(vars(sys.modules[cls.__module__]), known))
    except NameError:
        return {}


def check_attributes(cls: type, content: object, like: Mapping[str, Any]) -> None:
    """Check that an object of a class has the attributes that it needs, and no others; ``like`` are those of a new one.

    Raises:
        ValueError: There is one too many, or one is missing.
    """
    needed = _names(cls) if is_dataclass(cls) else like.keys()
    needed = {name for name in needed - not_stored(cls) if not is_computed(cls, name)}
    if not isinstance(content, dict) or not needed <= content.keys() <= _names(cls) | needed:
        found = sorted(content) if isinstance(content, dict) else content
        raise ValueError(f"found the attributes {found} of {cls.__name__}; expected {sorted(needed)}")


def check_value(cls: type, name: str, value: object, like: object) -> None:
    """Check the type of an attribute.

    Raises:
        ValueError: It is another one than that of ``like``, that of a new object, or than the annotation says.
    """
    hint = _hints(cls).get(name, Any) if is_dataclass(cls) else Any
    if not (is_alike(value, like) if hint is Any else fits(value, hint)):
        expected = type(like).__name__ if hint is Any else getattr(hint, "__name__", hint)
        raise ValueError(f"found {type(value).__name__}; expected {expected}")


def is_alike(value: object, like: object) -> bool:
    """Whether a value is of the same type as another; None tells nothing."""
    if value is None or like is None or (callable(value) and callable(like)):
        return True
    if isinstance(like, NUMBERS):
        return isinstance(value, NUMBERS)
    if isinstance(like, np.ndarray):
        return isinstance(value, np.ndarray) and value.dtype.kind == like.dtype.kind
    backends = {type(value).__name__, type(like).__name__} <= BACKENDS
    return type(value) is type(like) or backends


def fits(value: Any, hint: Any) -> bool:  # noqa: ANN401
    """Whether a value is what an annotation says."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if hint is Any or isinstance(hint, TypeVar):
        return True
    if kind in (Union, UnionType):
        return any(fits(value, part) for part in parts)
    if kind is Annotated:
        return fits(value, parts[0])
    if kind is Literal:
        return value in parts
    if kind in (None, NoneType):
        return value is None
    if kind in (bool, int, float):
        return isinstance(value, NUMBERS)
    if kind is np.ndarray:
        scalar = (get_args(parts[1]) or (Any,))[0] if len(parts) == 2 else Any
        if not isinstance(value, np.ndarray) or not isinstance(scalar, type):
            return isinstance(value, np.ndarray)
        return np.issubdtype(value.dtype, scalar if scalar is np.bool_ else scalar.__mro__[1])  # of any width
    if not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return True
    if kind.__module__ == "collections.abc":
        return callable(value) if kind.__name__ == "Callable" else isinstance(value, kind)
    if not isinstance(value, kind):
        return False
    if kind is tuple and parts and parts[-1] is not ...:
        return len(value) == len(parts) and all(map(fits, value, parts))
    if kind is dict and parts:
        return all(fits(key, parts[0]) and fits(one, parts[1]) for key, one in value.items())
    return not parts or kind not in (list, tuple, set, frozenset, deque) or all(fits(one, parts[0]) for one in value)
