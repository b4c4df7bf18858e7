"""The Bench view: sensors and checks before a test."""
