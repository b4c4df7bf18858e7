"""The Textual application. Follows a recording like any other reader.

Nothing is imported here: Textual loads when the application opens.
"""
