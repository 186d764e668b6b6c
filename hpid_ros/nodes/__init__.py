"""The ROS 2 shell: one node a file, each with its ``main``; nothing else imports rclpy."""
