"""Serves simulated devices on pseudo-terminals, TCP and UDP, in separate processes."""
