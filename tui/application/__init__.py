"""The application: follows a recording like anyone else, and starts and stops recorders.

Nothing in the package is imported here: Textual is loaded when the application is opened.
"""
