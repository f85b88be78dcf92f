"""File writing: a pool of writer processes, atomic renames, checksums, PNG and run-length encoders."""
