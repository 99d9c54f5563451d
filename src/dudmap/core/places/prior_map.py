"""Prior map: the result of a first pass over a recording, as input of the second."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.place_recognition import KeyframeDatabase


@dataclass(frozen=True, eq=False)
class PriorMap:
    """The map of a whole recording, which a second pass registers and labels its frames with.

    Attributes:
        volume: The map of the largest submap.
        submap: Number of that submap.
        Ts_world_camera: Poses (4, 4) of the frames tracked in it, by timestamp.
        keyframes: Keyframes of all submaps.
        detector: Holds the remembered frames of the first seconds.
    """

    volume: TsdfVolume
    submap: int
    Ts_world_camera: dict[float, NDArray[np.float64]]
    keyframes: KeyframeDatabase
    detector: DynamicDetector
