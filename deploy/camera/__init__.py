"""The depth camera of a hand, and where it stands."""
