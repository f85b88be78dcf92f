"""Networks that are trained on streams alone, scored on photographs: training, scores, a detector, ablations."""
