"""wallmirror: turn a wall into a mirror."""
