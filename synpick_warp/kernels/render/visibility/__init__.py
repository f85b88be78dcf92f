"""Primary visibility: cameras, view setup, triangle rasterizer, G-buffer."""
