"""Driver for the AX3, an invented triaxial accelerometer."""
