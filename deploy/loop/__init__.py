"""The control loop: from senses to goals at 12 Hz, its log, and its score."""
