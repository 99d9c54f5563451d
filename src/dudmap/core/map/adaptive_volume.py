"""Map with several voxel sizes (thesis section 7.1).

The blocks of ``TsdfVolume`` cover everything observed and alone hold free space. Finer blocks, of a half and a quarter
of the voxel size, refine them near detail (``refinement.py``); observed finer voxels replace coarser ones.
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.backends.parameters import BlockVisit, DepthView, FusionParameters, TouchedBlocks
from dudmap.core.backends.spec import Backend
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.map.fine_blocks import FineBlocks
from dudmap.core.map.level_meshes import level_meshes
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.paged_map import PagedMap
from dudmap.core.map.refinement import prolonged, refine
from dudmap.core.map.volume import TsdfVolume, fusion_parameters
from dudmap.core.map.voxel_blocks import VoxelBlocks


def make_volume(
    camera: Camera,
    config: VolumeConfig,
    sensor: SensorConfig,
    depth_max: float,
    backend: Backend | None = None,
    max_blocks: int | MemoryLimit | None = None,
) -> TsdfVolume:
    """An empty map, with several voxel sizes if ``volume.adaptive``; arguments of ``TsdfVolume``."""
    return TsdfVolume.kinds[config.adaptive](camera, config, sensor, depth_max, backend, max_blocks)


class AdaptiveVolume(TsdfVolume):
    """A map with smaller voxels at surface detail (curvature or texture) that the sensor resolves.

    Registration and labels read the coarsest level, so that poses and masks do not change. Mesh and views read the
    finest level (``docs/ranges.md``). ``levels``: finer levels, larger voxels first.
    """

    def _empty(self) -> None:
        super()._empty()
        levels: list[FineBlocks] = []
        for n in reversed(range(self.config.adaptive_levels)):
            levels.insert(0, FineBlocks(self.voxel_size / 2 ** (n + 1), self._new_blocks(), *levels[:1]))
        self.levels = levels

    @property
    def num_bytes(self) -> int:
        """Memory of all levels."""
        finer = 0
        for parents, level in zip(self._coarser, self.levels, strict=True):
            links = parents.num_slots * 8 * 4 + level.blocks.num_slots * (4 + 1)  # children; parent and calm
            finer += level.blocks.num_bytes + links
        return super().num_bytes + finer

    @property
    def _coarser(self) -> list[VoxelBlocks]:
        return self.all_blocks.parents

    def _parameters_of(self, n: int) -> FusionParameters:
        if n == 0:
            return self.parameters
        finer = self.config.model_copy(update={"voxel_size": self.voxel_size / 2**n})
        parameters = fusion_parameters(finer, self.sensor, self.depth_max)
        return parameters._replace(band=parameters.band._replace(limit=self.band.limit), sdf_unit=self.sdf_unit)

    # -- writing -----------------------------------------------------------------------------------------------------

    def _fuse(self, view: DepthView, count: int) -> tuple[NDArray[np.int32], TouchedBlocks]:
        fused, touched = super()._fuse(view, count)
        number = self._frame_number
        slots, updated = self.window.near, fused
        for n, (level, parents) in enumerate(zip(self.levels, self._coarser, strict=True)):
            level.make_room(parents)
            gone = parents.entry_of[updated] < 0
            level.drop(level.children_of(updated[gone]))
            children = level.children_of(slots)
            updated_children = self._average_finer(n, view, touched, children, count)
            updated = updated[~gone]
            centres = (parents.slot_coords[updated] + 0.5) * (self.block_size / 2**n)
            depths = (centres - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, 2]
            self._note_change(
                n, refine(level, parents, updated, depths, number, self.config, self.sensor, self._parameters_of(n))
            )
            slots, updated = children[level.blocks.entry_of[children] >= 0], updated_children
        return fused, touched

    def _average_finer(
        self, n: int, view: DepthView, touched: TouchedBlocks, candidates: NDArray[np.int32], count: int
    ) -> NDArray[np.int32]:
        """Fuse an image into candidate blocks of a finer level, drop empty ones; returns the slots."""
        if len(candidates) == 0:
            return candidates
        level, number = self.levels[n], self._frame_number
        blocks = level.blocks
        grid = level.grid(self.window.local_origin * 2 ** (n + 1), self.sdf_unit)
        turn = number if self.config.take_turns else -1
        slots, occupied, _ = self.backend.fuse(
            grid, view, touched, BlockVisit(candidates, blocks.fused, turn, count, None), self._parameters_of(n + 1)
        )
        self._note_change(n + 1, slots)
        blocks.fused[slots] = np.minimum(blocks.fused[slots], 254) + 1
        if self.config.carving:
            level.drop(slots[occupied == 0])
        return slots

    def _note_change(self, n: int, slots: NDArray[np.int32]) -> None:
        for level in self.levels[:n][::-1]:
            level.blocks.written[slots] = self._frame_number
            slots = level.parents[slots]
        self.blocks.written[slots] = self._frame_number

    def _take_level_colors(self, level: int, slots: NDArray[np.int32], other: PagedMap, number: int) -> None:
        """See ``PagedMap``; blocks without finer ones in the other map take interpolated colours."""
        assert isinstance(other, AdaptiveVolume)
        if level == 0:
            super()._take_level_colors(level, slots, other, number)
            return
        for finer in self.levels[:level]:
            slots = finer.children_of(slots)
        finer = self.levels[level - 1]
        interpolated = prolonged(self._coarser[level - 1], finer.parents[slots], finer.octants_of(slots))
        finer.take_colors(slots, other.levels[level - 1], interpolated)
        finer.blocks.written[slots] = number

    # -- reading -----------------------------------------------------------------------------------------------------

    def extract_chunks(
        self, slots: NDArray[np.int32], chunks: NDArray[np.int64], min_weight: int | None = None
    ) -> list[Mesh]:
        """See ``TsdfVolume.extract_chunks``; ``slots`` are of the coarsest level."""
        return level_meshes(self.blocks, self.levels, slots, chunks, self._mesh_parameters(min_weight))


TsdfVolume.kinds[True] = AdaptiveVolume
