"""Integration tests of the environment with published libraries of reinforcement learning."""
