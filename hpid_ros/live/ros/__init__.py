"""The page's client of the graph."""
