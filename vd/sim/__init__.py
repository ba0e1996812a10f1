"""Many worlds in Newton: scene building, stepping, guards."""
