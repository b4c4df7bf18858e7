"""The command line: options and help only. Nothing heavy is imported before a command runs."""
