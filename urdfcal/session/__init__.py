"""One measured data set in memory: robot, LEDs, cameras and what was measured."""
