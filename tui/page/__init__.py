"""What outputs consist of, and a renderer each for terminals and HTML."""
