"""From a session to the parameters of the robot that was really built."""
