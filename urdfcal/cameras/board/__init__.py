"""Camera calibration from pictures of a chessboard or ChArUco board."""
