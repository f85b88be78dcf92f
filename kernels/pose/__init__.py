"""Object pose estimation from masks, depth and colour: observations, residuals, refinement, template search, hypotheses;
and nearest vertices for ADD-S."""
