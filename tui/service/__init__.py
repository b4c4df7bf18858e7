"""The service behind ``huddle serve``: runs by schedule, a database of them, and hooks."""
