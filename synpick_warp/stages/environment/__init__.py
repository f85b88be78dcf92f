"""Host side of the batched environment: piles at rest, attempts and twists, observations."""
