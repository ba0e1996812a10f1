"""Training: rsl-rl runners, presets and the vd-train command line."""
