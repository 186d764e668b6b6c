"""The physics of the simulated robot."""
