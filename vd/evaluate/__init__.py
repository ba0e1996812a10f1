"""Deterministic evaluation of policies: rollouts, statistics, reports."""
