"""MCAP files, finished or cut off."""
