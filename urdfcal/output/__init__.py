"""What leaves the program besides the URDF: recordings and reports."""
