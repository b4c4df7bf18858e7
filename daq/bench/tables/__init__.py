"""Tables of the bench file that stand for themselves, and what all tables are made of."""
