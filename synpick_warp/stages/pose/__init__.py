"""Object pose estimation."""
