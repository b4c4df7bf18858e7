"""The noise of each channel over months, and whether it has changed."""
