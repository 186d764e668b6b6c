"""What compares, identifies, certifies, tunes and shows: hpid_ros drives the robot."""
