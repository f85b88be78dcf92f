"""Point clouds of views."""
