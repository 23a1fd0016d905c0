"""urdfcal: make the URDF match the arm, with two cameras and an LED."""
