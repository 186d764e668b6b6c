"""The URDF as a record, kinematics, dynamics, shapes, rolling base, model terms of a loop."""
