"""The operations of ``core/backends/spec.py`` on NVIDIA GPUs, with Warp (extra ``gpu``)."""
