"""Wire protocols, sans-IO: bytes in, blocks out."""
