"""Subcommands that move a robot that runs: they ask first, and stop at every limit."""
