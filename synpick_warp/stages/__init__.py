"""Host side of the kernels: every launch and every allocation."""
