"""Device code that replaces kernels of Newton; `synpick_warp/newton_patches` says which, and why."""
