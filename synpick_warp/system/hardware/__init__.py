"""Hardware and its limits: compute devices, cores, memory, caches of kernels and shapes."""
