"""Host side of the vector environment: checkpoint bank of piles, attempts, twist control, observations."""
