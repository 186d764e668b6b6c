"""Many runs: sweeps, searches and studies, on every core and without ROS."""
