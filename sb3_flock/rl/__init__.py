"""The Stable-Baselines3 plugin: features extractor, policies, replay buffer, algorithm, callbacks and the registry."""
