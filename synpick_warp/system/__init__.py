"""The machine: devices, memory, caches, descriptors, signals."""
