"""A mapping session on ROS messages, without ROS: processing of image pairs, and the services of the node."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dudmap.cli.output import free_folder
from dudmap.config import Config, keys
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.places.saved_map import KEYFRAME_FILE, MAP_FILE, SavedMap
from dudmap.core.result import FrameResult
from dudmap.core.slam import Slam
from dudmap.errors import ConfigError, DatasetError, MapError
from dudmap.fleet.change_watch import ChangeWatch
from dudmap.io.exporting import ros_messages as ros
from dudmap.io.sequences.bag_messages import color_of, depth_of
from dudmap.io.sequences.images import read_ignored
from dudmap.ranges import RANGES


def default_parameters() -> dict[str, Any]:
    """All configuration keys with their default values, tuples as lists."""
    tree = Config().model_dump()
    out: dict[str, Any] = {}
    for key in keys():
        part, _, name = key.partition(".")
        value = tree[part][name] if name else tree[part]
        out[key] = list(value) if isinstance(value, tuple) else value
    return out


def config_of(values: Mapping[str, Any], range_name: str = "room") -> Config:
    """Configuration of dotted keys. Keys with the default value leave the choice to the range.

    Raises:
        ConfigError: A value is invalid.
    """
    if range_name not in RANGES:
        raise ConfigError(f"found the range {range_name!r}; expected one of {', '.join(RANGES)}")
    defaults, tree = default_parameters(), {}
    for key, value in values.items():
        value = list(value) if isinstance(defaults[key], list) else value
        if value != defaults[key]:
            part, _, name = key.partition(".")
            if name:
                tree.setdefault(part, {})[name] = value
            else:
                tree[part] = value
    return Config.from_tree(tree, RANGES[range_name])


class Session:
    """One map that grows with every pair of images.

    Args:
        config: All parameters.
        saved_map: Run folder to continue, None for a new map.
        localize: Only find the camera in the saved map.
        watch: Report changes against the saved map.
        ignore: Image, white at the pixels to ignore; None uses all.

    Attributes:
        slam: The system; None before the first pair.
        watch: Changes against the saved map; None before the first pair or without a saved map.
        processed: Number of processed pairs.
        stale: Number of dropped pairs, which were not newer than the previous pair.

    Raises:
        ConfigError: ``localize`` or ``watch`` without a saved map.
    """

    def __init__(
        self,
        config: Config,
        saved_map: str | None = None,
        localize: bool = False,
        watch: bool = False,
        ignore: str | None = None,
    ) -> None:
        if watch and saved_map is None:
            raise ConfigError("there is no earlier visit to compare with; set the parameter saved_map to a run folder")
        if localize and saved_map is None:
            raise ConfigError("there is nothing to localise in; set the parameter saved_map to a run folder")
        self.config = config
        self.saved_map, self.ignore = saved_map, ignore
        self.localize, self.watching = localize, watch
        self.reset()

    def reset(self) -> None:
        """Drop the map; the next pair reloads the saved map, or starts a new one."""
        self.localize = self.localize and self.saved_map is not None
        self.slam: Slam | None = None
        self.watch: ChangeWatch | None = None
        self.processed = self.stale = self._saved = 0
        self._last = float("-inf")

    def set_localize(self, localize: bool) -> None:
        """Stop or continue changing the map.

        Raises:
            MapError: There is no map to localise in.
        """
        if localize and self.saved_map is None and (self.slam is None or self.slam.volume.is_empty):
            raise MapError("there is no map to localise in; map first, or set the parameter saved_map")
        self.localize = localize
        if self.slam is not None:
            self.slam.localize = localize

    def process(self, depth: Any, color: Any, info: Any) -> FrameResult | None:  # noqa: ANN401
        """Process a depth image registered to colour, a colour image and the camera_info of both.

        Returns:
            None for a pair that is not newer than the last one.

        Raises:
            DatasetError: An encoding is unknown, the camera is not calibrated, or the images differ in size.
        """
        stamp = ros.seconds_of(depth)
        if stamp <= self._last:
            self.stale += 1
            return None
        z, rgb = depth_of(depth, 1000.0, "the depth image"), color_of(color, "the colour image")
        if z.shape != rgb.shape[:2]:
            sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in (z, rgb)]
            raise DatasetError(
                f"depth is {sizes[0]} and colour {sizes[1]}; subscribe to the depth that the driver aligns to colour"
            )
        if self.slam is None:
            self.slam = self._started(info)
        self._last = stamp
        self.processed += 1
        frame = Frame(stamp, z, rgb)
        result = self.slam.process(frame)
        if self.watch is not None:
            self.watch.look(self.processed - 1, frame, result)
        return result

    def mesh(self) -> Mesh | None:
        """Static surface of the main map, None before there is one."""
        if self.slam is None:
            return None
        volume = self.slam.maps[0][1]
        return None if volume.is_empty else volume.extract_mesh()

    def save(self, folder: str | Path) -> Path:
        """Write the map as a run folder: trajectory.txt, mesh.ply, map.npz, keyframes.npz, config.toml.

        Raises:
            MapError: There is no map yet, or a file cannot be written.
        """
        mesh, folder = self.mesh(), Path(folder)
        if self.slam is None or mesh is None:
            raise MapError("there is no map to save yet")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            trajectory, volume = self.slam.maps[0]
            trajectory.save(folder / "trajectory.txt")
            self.config.save(folder / "config.toml")
            mesh.save(folder / "mesh.ply")
            volume.save(folder / MAP_FILE)
            self.slam.saved_map.save_keyframes(folder / KEYFRAME_FILE)
        except OSError as error:
            raise MapError(f"cannot write into {folder}: {error.strerror or error}") from error
        self._saved = self.processed
        return folder

    def save_rest(self, folder: str | Path) -> Path | None:
        """Save a map that has grown since the last save into the first free of ``folder``, ``folder-2``, ...

        Raises:
            MapError: A file cannot be written.
        """
        if self.localize or self.processed == self._saved or self.slam is None or self.slam.maps[0][1].is_empty:
            return None
        return self.save(free_folder(Path(folder)))

    def _started(self, info: Any) -> Slam:  # noqa: ANN401
        camera = ros.camera_of(info)
        ignored = None if self.ignore is None else read_ignored(self.ignore, camera)
        if self.saved_map is None:
            return Slam(camera, self.config, live=True, ignore=ignored)
        saved = SavedMap.load(self.saved_map, self.config.volume.voxel_size)
        slam = Slam(camera, self.config, live=True, saved_map=saved, ignore=ignored)
        slam.localize = self.localize
        if self.watching:
            # a copy, because the system changes its saved map
            self.watch = ChangeWatch(SavedMap.load(self.saved_map))
            self.watch.start(slam, None, None)
        return slam
