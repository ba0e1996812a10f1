"""A hand without the hand: the simulator in place of motors and camera."""
