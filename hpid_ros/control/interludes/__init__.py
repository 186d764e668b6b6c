"""What may interrupt a loop, and what acts on its joint for a while in its place or beside it."""
