"""Modbus devices: samples in registers, block FIFOs."""
