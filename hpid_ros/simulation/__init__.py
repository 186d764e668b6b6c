"""The simulated robot in PyBullet or MuJoCo, and the whole loop around it without ROS."""
