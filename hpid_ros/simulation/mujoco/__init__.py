"""A robot in MuJoCo."""
