"""Simulated motion, sensors, clocks and noise: functions of time, equal in every process."""
