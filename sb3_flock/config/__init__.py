"""The composition of the parts' settings into the config of a whole training."""
