"""Models of the robot in the loops: gravity, decoupling, and the states that they need."""
