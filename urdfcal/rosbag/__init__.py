"""Recordings of ROS 1 and ROS 2 made into sessions, without ROS."""
