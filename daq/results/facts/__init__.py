"""What is known of a test beyond its numbers: one class per kind of fact, and its makers."""
