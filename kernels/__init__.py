"""Warp kernels by role, CPU and CUDA from one source; knows Warp only."""
