"""Online generator: views of a bake as batches that stay on the device, for training without files."""
