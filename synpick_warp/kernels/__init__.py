"""Device code: Warp functions and kernels. Launched from `synpick_warp.stages` only."""
