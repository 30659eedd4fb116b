"""Images of a flock."""
