"""USD scenes: one layer per episode that references a shared asset library."""
