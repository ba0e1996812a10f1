"""Training of the network of alignment."""
