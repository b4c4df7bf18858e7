"""What the averages say about the test itself: bands, orientation, advice."""
