"""Dataset writers: view and tick batches in, committed episodes on disk out."""
