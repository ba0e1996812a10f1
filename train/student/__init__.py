"""Training of the student: imitation of the teacher from point clouds, and pre-training of its encoder."""
