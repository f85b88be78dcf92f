"""Device code of the batched environment: starts of episodes, actions, observations."""
