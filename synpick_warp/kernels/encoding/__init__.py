"""Image encoders on the device."""
