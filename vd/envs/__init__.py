"""The reorientation task: configuration and the batched environment."""
