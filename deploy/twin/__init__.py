"""A hand without the hand: simulated motors and camera that speak the real protocols."""
