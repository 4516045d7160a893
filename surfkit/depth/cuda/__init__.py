"""PatchMatch on NVIDIA GPUs."""
