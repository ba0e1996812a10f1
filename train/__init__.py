"""Training: the teacher with PPO (rsl-rl), its presets, checkpoints and command line."""

import os

# rsl-rl's logger imports GitPython, which refuses to be imported on a machine without a git binary.
# Nothing here depends on git, so its absence must not stop a run.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
