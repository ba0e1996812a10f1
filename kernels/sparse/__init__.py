"""Kernels of sparse convolutions: voxels and coordinate maps."""
