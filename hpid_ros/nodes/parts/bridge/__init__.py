"""Parts of the bridge to the simulated robot."""
