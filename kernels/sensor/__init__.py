"""Kernels of the senses: depth images, their errors, clouds, and where a known shape is in them."""
