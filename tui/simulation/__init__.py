"""Simulated benches and simulated recordings for the command."""
