"""Online generator: the views of a bake as batches on the device, for training without files."""
