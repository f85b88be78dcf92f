"""Adapters of `synpick_warp.make_env` for libraries of reinforcement learning, to be copied or imported; each needs its library."""
