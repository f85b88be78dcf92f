"""Format conversion of baked data sets. Output files equal those of a bake byte for byte, unless the source stores its data with loss."""
