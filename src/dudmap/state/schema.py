"""What a stored state may hold: the classes of its objects, and for each of them the names and types of its attributes.

A state is data. Its classes are the table ``CLASSES``; attributes of a dataclass are its fields with their annotations,
those of another class what its methods name, of the types that they have in a new object of the class.
"""

import sys
from collections import ChainMap, deque
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import cache
from importlib import import_module
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from dudmap.state import wiring

CLASSES = """
bootstrap:StartFrame,Bootstrap calibration.adjustment:_State,_PairSystems,_System,Adjustment
calibration.collector:KeyframeCollector calibration.depth_estimator:DepthView calibration.depth_model:DepthModel
calibration.estimator:Estimate,_Trial,CalibrationEstimator calibration.keyframes:ColorKeyframe calibration.pairs:Pair
calibration.self_calibration:SelfCalibration color_calibration:ColorCalibration
config:ConfigSection,SensorConfig,PreprocessConfig,SimilarityConfig,VolumeConfig,TrackerConfig,DynamicsConfig,RelocalizationConfig,LoopsConfig,SubmapsConfig,MoversConfig,Config
dynamics.background_model:BackgroundModel dynamics.detector:_Comparison,DynamicDetector
dynamics.dominant_motion:LabelledCorners,DominantMotion dynamics.ego_motion:OlderImage,SlowMotion,EgoMotionSegmenter
dynamics.masks:Labels dynamics.mixture:Mixture dynamics.segments:Segmentation,SegmentEvidence
dynamics.temporal_memory:RememberedFrame,TemporalMemory frames.depth_correction:DepthCorrection
frames.frame:FrameArrays,Frame frames.observation:Observation,Level frames.preprocess:Preprocessor
frames.pyramid:Pyramid frames.stream_check:Rejection,StreamCheck geometry.alignment:Alignment
geometry.association:TimedFile geometry.calibration:Calibration geometry.camera:Camera geometry.lens:Lens
geometry.mesh:Mesh geometry.other_view:OtherView geometry.trajectory:Trajectory
kernels.consensus:ConsensusParams,LinearizedMotions,Correspondences kernels.descent:DescentRules,Descent
kernels.evidence:ResidualCounts,EvidenceParameters,NoiseParameters,ReadingNoise kernels.mirror:Mirror
kernels.parameters:SensorNoise,TruncationBand,FusionParameters,RegistrationParameters,ColorProjection,RaycastParameters,MeshParameters,FilterParameters,VoxelGrid,DepthTiles,DepthView,FusedBlocks,NormalEquations,MapSample,RaycastResult,MeshArrays
kernels.reprojection:ReprojectionTarget,Reprojection kernels.segmentation:SegmentSums,SegmentImage
kernels.splatting:PointImage mapper:Mapper mapping.adaptive_volume:AdaptiveVolume mapping.block_pager:_Away,BlockPager
mapping.block_tree:BlockTree mapping.block_window:BlockWindow mapping.fine_blocks:FineBlocks
mapping.incremental_mesh:IncrementalMesh mapping.integrator:StorageScale,Integrator mapping.map_file:MapContent
mapping.memory_limit:MemoryLimit mapping.paged_map:PagedMap mapping.refinement:Refinement
mapping.region_store:RegionStore mapping.volume:TsdfVolume mapping.volume_mirror:VolumeMirror
mapping.voxel_blocks:BlockRecords,VoxelBlocks objects.moving_objects:_Frame,MovingObjects
objects.object_fusion:ObjectFusion objects.object_map:RigidObject,ObjectVolume,ObjectTrack
objects.object_tracker:Mover,_Measurement,_Track,ObjectTracker objects.object_view:ObjectView
objects.regions:MovingPixels,Region objects.scene_flow:InstanceFrame pipeline.metrics:RunRecord
places.atlas:TimedPose,Atlas places.features:ImageFeatures,SiftExtractor places.frame_file:FilePlace,FrameFile
places.frame_store:StoredFrame,RemovedFrames,FrameStore places.frame_thinning:FrameThinning
places.glimpse:Glimpse,Visibility places.loop_closing:LoopSearch,PendingCorrection,LoopCloser
places.loop_correction:LoopCorrector places.loop_verification:LoopQuery,LoopVerifier
places.map_rebuilding:MapRebuilding places.place_recognition:PlacedFeatures,Keyframe,PlaceMatch,KeyframeDatabase
places.pose_graph:Edge places.prior_map:PriorMap places.redundancy:DescribedImage,SimilarityTest,_Place,RedundantViews
places.relocalizer:Relocalization,Relocalizer places.saved_map:SavedMap result:FrameResult slam:Slam
stage_timer:StageTimer tracking.color_motion:RegisteredLevel,ColorMotion tracking.depth_noise:DepthNoise
tracking.estimate:PoseEstimate tracking.frame_view:FrameView tracking.front_end:FrontEnd
tracking.gradient_agreement:GradientAgreement tracking.image_consistency:ImageComparison,ImageConsistency
tracking.motion_model:MotionModel tracking.observability:Observability,GradientNoise
tracking.pose_prediction:PosePrediction,PosePredictor
tracking.quality_monitor:RegistrationHistory,Verdict,QualityMonitor tracking.tracker:TrackingResult,Minimum,Tracker
"""
"""All classes whose objects may be stored, and made from what is stored: modules of this package and names in them."""
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
    """The class of a name.

    Raises:
        ValueError: It is none whose objects are stored.
    """
    module = _table().get(name) if isinstance(name, str) else None
    if module is None:
        raise ValueError(f"found a {name!r}, which this version does not know")
    return getattr(import_module(module), str(name).partition(":")[2])


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
    """Check the names of the attributes of an object.

    Args:
        cls: Its class.
        content: Its attributes as stored.
        like: Those of a new object, if there is one.

    Raises:
        ValueError: There is one too many, or one is missing.
    """
    needed = _names(cls) if is_dataclass(cls) else like.keys()
    needed = {name for name in needed - wiring.rebuilt(cls) if not wiring.is_computed(cls, name)}
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


def fits_fields(value: object) -> bool:
    """Whether the attributes of a dataclass are what their annotations say."""
    return all(fits(getattr(value, name), hint) for name, hint in _hints(type(value)).items())


def is_alike(value: object, like: object) -> bool:
    """Whether a value is of the same type as another; None tells nothing."""
    if value is None or like is None or (callable(value) and callable(like)):
        return True
    if isinstance(like, NUMBERS):
        return isinstance(value, NUMBERS)
    if isinstance(like, np.ndarray):
        return isinstance(value, np.ndarray) and value.dtype.kind == like.dtype.kind
    backends = {type(value).__name__, type(like).__name__} <= wiring.BACKENDS
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
