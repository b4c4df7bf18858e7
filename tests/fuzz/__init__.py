"""Coverage-guided fuzzing of every decoder; see ``docs/validation/fuzzing.md``."""
