"""What an archive says, as tables, JSON and CSV."""
