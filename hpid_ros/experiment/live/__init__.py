"""Work on a graph that runs already, on a real robot or a simulated one."""
