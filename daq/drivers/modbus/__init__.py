"""Modbus devices: readings in registers, and block FIFOs."""
