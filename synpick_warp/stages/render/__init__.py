"""Host side of the renderer."""
