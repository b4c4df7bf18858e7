"""What the service starts, and the locks by which it finds that again."""
