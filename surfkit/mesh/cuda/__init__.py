"""Fusion of depth maps on NVIDIA GPUs."""
