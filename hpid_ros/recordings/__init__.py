"""Runs as arrays, below bags and analysis: series and quality."""
