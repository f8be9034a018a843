"""Many trainings or evaluations at once, on one machine or a Ray cluster, and the statistics over them."""
