"""Embedded assets, made procedurally: 21 household objects with textures, seven industrial parts, and six HDR environment maps."""
