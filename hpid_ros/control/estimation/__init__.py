"""What a joint does, found from what its encoder tells and what was sent to it."""
