"""The unknowns of an estimate, one file for each kind (METHOD 7)."""
