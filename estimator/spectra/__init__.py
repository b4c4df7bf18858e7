"""Cross-spectral matrices by Welch's method: windows, octaves, rejection of segments."""
