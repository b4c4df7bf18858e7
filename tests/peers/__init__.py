"""Programs we did not write, on our wires."""
