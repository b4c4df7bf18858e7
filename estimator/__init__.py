"""Self-noise of collocated sensors: numbers in, numbers out."""
