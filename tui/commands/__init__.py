"""One module a command, named after it: what the command does."""
