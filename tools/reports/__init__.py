"""Reports on settled piles, picking sequences and image quality, with bounds."""
