"""Forms over a view, checked while they are typed."""
