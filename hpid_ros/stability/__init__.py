"""Stability of one joint's loop: certificates, their search and their check, verdicts on gains."""
