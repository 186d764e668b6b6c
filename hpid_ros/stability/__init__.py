"""Certificates of stability, verdicts on gains, and margins of the frozen loop."""
