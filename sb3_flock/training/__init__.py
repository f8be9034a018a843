"""A whole training: one config in, one run folder out, resumable to the last bit."""
