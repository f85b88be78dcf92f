"""Device code of the vector environment: settling of piles, actions, observations."""
