"""Device code of the renderer: visibility, lighting, output images."""
