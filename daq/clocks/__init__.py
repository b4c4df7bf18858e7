"""When each sample was taken: clocks, and all sensors on one grid."""
