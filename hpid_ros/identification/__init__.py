"""Identification: what a joint's motor moves and what holds it back, from recorded motion."""
