"""The database of runs, and the files that belong to them."""
