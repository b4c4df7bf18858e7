"""Alignment: clocks, resampling, the common grid."""
