"""Examples of training, run as `python -m tools.examples.NAME`, and adapters for libraries of reinforcement learning."""
