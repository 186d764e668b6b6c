"""Performance indices: arrays in, named numbers out."""
