"""Watching a policy: web viewer and headless video."""
