"""Writing: the writer process pool, atomic files, checksums, image encoders."""
