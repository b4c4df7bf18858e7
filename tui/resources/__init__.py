"""Files that come with the command: bench files and the application's style sheet."""
