"""Linux Industrial I/O devices over the network."""
