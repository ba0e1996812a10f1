"""Running a policy on hardware; reuses the kernels on CPU (arrives with the student)."""
