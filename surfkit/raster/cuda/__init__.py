"""CUDA kernels of this folder, and how they are called."""
