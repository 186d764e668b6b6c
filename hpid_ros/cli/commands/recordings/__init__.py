"""Commands that take a recording as it is."""
