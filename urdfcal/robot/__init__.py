"""The robot as drawn: its URDF, the chain of joints that is calibrated, its DH rows, its kinematics."""
