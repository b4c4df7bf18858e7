"""Studies of tests drawn at random: many things vary together, so unforeseen cases are seen."""
