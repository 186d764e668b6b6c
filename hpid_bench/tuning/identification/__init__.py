"""Joints identified from their recorded motion and efforts."""
