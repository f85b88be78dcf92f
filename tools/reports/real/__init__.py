"""Sim-to-real transfer of segmentation: training on streams alone, scores on photographs."""
