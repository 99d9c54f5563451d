"""Operations on images and voxels (``spec.py``), on a CPU (``cpu``) and on an NVIDIA GPU (``warp``)."""
