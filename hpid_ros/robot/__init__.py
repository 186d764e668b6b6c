"""Robots: the URDF as a record, kinematics, dynamics, and the model terms of a loop."""
