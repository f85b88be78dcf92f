"""FrameBatch in, whole episodes on disk out."""
