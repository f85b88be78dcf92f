"""Output images: anti-aliasing, post-processing, annotation layers, boxes and masks."""
