"""Experiment files: run on a graph or in one process, swept, searched, studied."""
