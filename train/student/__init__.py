"""Training of the network by which a teacher acts on what a camera sees, without a mesh."""
