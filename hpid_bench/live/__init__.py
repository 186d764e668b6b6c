"""A running robot: the page, its client of the graph, excitation and relay tests."""
