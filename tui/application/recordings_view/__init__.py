"""The Recordings view: what the bench has recorded."""
