"""The five processes and the simulated robot as rclpy nodes."""
