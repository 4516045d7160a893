"""k-means on NVIDIA GPUs."""
