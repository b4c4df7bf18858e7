"""Maximum likelihood as factor analysis, its precision, dimension and model test."""
