"""What acts on a joint for a while in place of its law, or beside it."""
