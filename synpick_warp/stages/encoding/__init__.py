"""Image encoding on the device."""
