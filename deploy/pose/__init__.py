"""Where the object is, as somebody outside tells it: a tracker, a motion capture, tags on a cube."""
