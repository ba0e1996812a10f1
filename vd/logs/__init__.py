"""What machines were told and what they did, as files: recordings of motions and their checks."""
