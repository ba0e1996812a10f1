"""Hands and objects authored as USD, and read back from it."""
