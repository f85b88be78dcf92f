"""Batches of rendered views that stay on the device, for consumers in the same process."""
