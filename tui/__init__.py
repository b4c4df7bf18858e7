"""Terminal front ends: the `huddle` command and the application."""
