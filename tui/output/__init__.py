"""Results as tables, sentences, JSON and CSV. Sentences are made here and nowhere else."""
