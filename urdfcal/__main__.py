"""``python -m urdfcal``."""

from urdfcal.cli import main

main()
