"""Many trainings or flights at once, on one machine or a Ray cluster, and what they say together."""
