"""File formats that host and device encode to the same bytes: JPEG, and depth as PNG."""
