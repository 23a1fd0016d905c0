"""The robot: its URDF, the chain or tree of joints that is calibrated, its DH rows and its kinematics."""
