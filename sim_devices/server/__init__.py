"""Serves simulated devices on pseudo-terminals, TCP and UDP, in processes of their own."""
