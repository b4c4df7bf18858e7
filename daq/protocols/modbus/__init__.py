"""Modbus: RTU frames, readings in registers, block FIFOs."""
