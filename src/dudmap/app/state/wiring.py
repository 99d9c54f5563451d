"""What of the objects of a run is not stored as it is: connections, threads, files and buffers that are made anew."""

from functools import cached_property
from typing import Any

REBUILT = {
    "Atlas": ("make_volume",),  # a method of Slam
    "BlockPager": (  # the regions have a table
        "_store",
        "_executor",
        "_away",
        "_writing",
        "_reading",
        "_unchanged_since",
        "_serial",
        "_archived",
        "_archive",
    ),
    "FrameStore": (  # the frames have a table
        "registered",
        "_places",
        "_glimpses",
        "_file",
        "_encoder",
        "_pending",
        "archived",
    ),
    "KeyframeDatabase": ("_sift",),
    "LoopCloser": ("_executor",),
    "Observation": ("_halvings", "_recorded_halvings"),  # computed once per image, from it alone
    "SimilarityTest": ("_sift",),
    "Slam": ("device",),  # a run may be continued on another one
    "TsdfVolume": (
        "blocks",
        "window",
        "levels",
        "map_id",
    ),  # the blocks have a table; the number is one of this process
}
"""Attributes by class that a new object makes itself, so that they are not part of the state."""
BACKENDS = frozenset({"CpuBackend", "WarpBackend"})
"""Classes of back ends, which hold nothing that is part of the state: a new one may be of another device."""
EVALUATED = {"FrameView": ("segmentation",)}
"""Attributes that are functions without arguments, of which the result is stored."""
CONSTANT = frozenset({"PlacedFeatures", "Preprocessor"})
"""Classes whose arrays never change once they are made: they need not be copied for a snapshot."""
RECORDS = {"RunRecord": ("rows", "lost", "movers", "unreadable", "checks")}
"""Attributes that are lists of plain values which only grow; they are stored as lines of JSON."""
COLUMNS = frozenset({"TimedPose"})
"""Classes of which many objects stand in one list and nowhere else; they are stored attribute by attribute."""


def rebuilt(cls: type) -> set[str]:
    """Attributes that objects of a class make themselves."""
    return {name for base in cls.__mro__ for name in REBUILT.get(base.__name__, ())}


def attributes(value: Any) -> dict[str, Any]:  # noqa: ANN401
    """The attributes of an object that are its state, in the order in which they were set.

    Values that ``functools.cached_property`` keeps are left out: they follow from the others.
    """
    left_out = rebuilt(type(value))
    return {
        name: content
        for name, content in vars(value).items()
        if name not in left_out and not is_computed(type(value), name)
    }


def is_computed(cls: type, name: str) -> bool:
    """Whether an attribute is one that ``functools.cached_property`` keeps."""
    return isinstance(getattr(cls, name, None), cached_property)
