"""Reinforcement-learning environments beside the planners."""
