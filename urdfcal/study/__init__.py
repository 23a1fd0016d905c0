"""Many calibrations at once: a fleet's sessions, on joblib's engines."""
