"""Kernels of the senses: depth images, their errors, clouds; and distances from shapes."""
