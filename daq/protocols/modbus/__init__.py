"""Modbus: RTU frames, samples in registers, block FIFOs."""
