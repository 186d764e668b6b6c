"""Robots: the URDF as a record, kinematics, dynamics, shapes, the rolling base, and the model terms of a loop."""
