"""CSV and other delimited text, as loggers and spreadsheets write it."""
