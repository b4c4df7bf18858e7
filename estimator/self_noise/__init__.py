"""The self-noise methods in closed form, their bias and uncertainty."""
