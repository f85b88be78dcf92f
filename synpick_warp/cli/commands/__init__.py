"""The commands beside `bake`: options and calls of each."""
