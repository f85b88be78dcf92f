"""Conversion of baked data sets to further formats: the bytes that a bake would have written, wherever the source is lossless for them."""
