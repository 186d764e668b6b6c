"""Gains, identification, upgrade of a recorded PID, replay, and export to C."""
