"""The Stable-Baselines3 plugin: features extractor, policies, callbacks and the training function."""
