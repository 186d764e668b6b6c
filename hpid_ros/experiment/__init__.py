"""An experiment file, run on the graph or in one process, and the result that it leaves."""
