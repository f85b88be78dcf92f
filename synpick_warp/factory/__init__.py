"""The bake: assembly and compilation of its stages, memory plan, order of episodes, device processes, pipeline from ticks to files."""
