"""The simulated motion, sensors, clocks and noise: functions of time, alike in every process."""
