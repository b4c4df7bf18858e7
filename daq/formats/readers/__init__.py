"""One module for each family of files, and the library that reads it."""
