"""Wavefront import: OBJ meshes and MTL materials."""
