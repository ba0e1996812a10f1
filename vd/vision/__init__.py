"""The student: point clouds to voxels, and a sparse 3-D network with memory that acts on them."""
