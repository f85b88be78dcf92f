"""Embedded assets, made procedurally: 21 household objects with textures, and six HDR environment maps."""
