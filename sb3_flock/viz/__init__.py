"""Figures, video and the window: how rollouts and trainings look."""
