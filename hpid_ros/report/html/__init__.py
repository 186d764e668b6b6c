"""The report of a comparison as one web page."""
