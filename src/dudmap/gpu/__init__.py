"""The operations of ``kernels/backend.py`` on NVIDIA GPUs, by Warp (extra ``gpu``)."""
