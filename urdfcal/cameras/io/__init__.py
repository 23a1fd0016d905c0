"""Camera files: Kalibr, ROS and OpenCV, read and written."""
