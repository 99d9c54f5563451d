"""The voxel-hashed signed distance field: allocation, integration, sampling, ray casting and meshing."""

from dudmap.core.map import adaptive_volume  # noqa: F401 - its class is found by TsdfVolume.load
