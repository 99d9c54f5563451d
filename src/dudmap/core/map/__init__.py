"""The voxel-hashed signed distance field: allocation, integration, sampling, ray casting and meshing."""
