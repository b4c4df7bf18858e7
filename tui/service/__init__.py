"""The service behind ``huddle serve``: runs by schedule, kept in a database, told about."""
