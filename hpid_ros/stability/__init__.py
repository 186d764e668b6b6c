"""Certificates of stability for intervals of the degree, and margins of the frozen loop."""
