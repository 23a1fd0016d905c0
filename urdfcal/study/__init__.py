"""Many calibrations at once, on joblib's engines: a fleet's sessions, and simulated arms."""
