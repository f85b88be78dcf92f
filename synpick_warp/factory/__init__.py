"""Assembly of the stages on a device from all settings, and ahead-of-time compilation of their kernels."""
