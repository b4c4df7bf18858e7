"""The pages of a bench in the browser."""
