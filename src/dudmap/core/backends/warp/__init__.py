"""The operations of ``core/backends/spec.py`` on NVIDIA GPUs, by Warp (extra ``gpu``)."""
