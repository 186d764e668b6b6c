"""An experiment on the graph: processes, parameter files, isolation."""
