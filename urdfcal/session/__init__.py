"""One measured data set: its model, its files, and simulated ones from a known truth."""
