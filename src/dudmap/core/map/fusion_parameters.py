"""Parameters of the fusion that follow from the configuration of a map."""

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.backends.parameters import FusionParameters, SensorNoise, TruncationBand

DEPTH_MIN = 0.05
"""Blocks nearer to the camera than this are not updated, metres."""
MIN_LIMIT = 0.3
"""Smallest limit of the distances that voxels can store, metres."""


def fusion_parameters(config: VolumeConfig, sensor: SensorConfig, depth_max: float) -> FusionParameters:
    """Parameters of a map whose readings end at ``depth_max`` metres."""
    front = config.truncation_voxels * config.voxel_size
    behind = config.truncation_behind_voxels * config.voxel_size
    limit = max(MIN_LIMIT, front, behind)
    noise = SensorNoise(sensor.sigma_base, sensor.sigma_scale)
    return FusionParameters(
        band=TruncationBand(front, behind, config.truncation_noise, limit, noise),
        voxel_size=config.voxel_size,
        sdf_unit=limit / 32767,
        depth_unit=depth_max / 65534,
        max_weight=config.max_weight,
        max_readings=config.max_readings,
        carve_rate=config.carve_rate if config.carving else 1,
        depth_min=DEPTH_MIN,
        depth_max=depth_max,
    )
