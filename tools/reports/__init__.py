"""Reports: measured behaviour of piles, picking and pictures."""
