"""Foreign file formats, in and out."""
