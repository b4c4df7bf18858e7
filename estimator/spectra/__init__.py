"""Cross-spectral matrices by Welch averages: windows, octaves, rejected segments."""
