"""Whether noise is below masks: on arrays alone."""
