"""Real clients of the environment: libraries of reinforcement learning, as they are published."""
