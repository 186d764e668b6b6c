"""From the messages of a bag to the series of each joint."""
