"""A check of the texts that a person reads, by a list of habits and terms: `python -m tests.prose`."""
