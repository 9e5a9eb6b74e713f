"""Training: labelled data, the value network, reinforcement learning, and their comparison."""
