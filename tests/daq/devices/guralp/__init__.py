"""GCF and the links it comes over."""
