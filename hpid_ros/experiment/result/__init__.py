"""The result of an experiment: its folder, its numbers, its figures."""
