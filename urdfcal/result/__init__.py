"""The calibrated robot: loaded, applied, saved."""
