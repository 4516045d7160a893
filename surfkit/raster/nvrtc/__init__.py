"""CUDA C++ kernels: compiled at run time by NVRTC for GPUs, run by an emulator in tests without one.

`prelude.h` says what a kernel source may use. A folder with kernels has them in its own cuda/, as .cu files.
"""
