"""The nodes of the graphs that the package is measured against."""
