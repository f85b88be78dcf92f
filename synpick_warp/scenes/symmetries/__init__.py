"""Symmetries of objects: declared in the object table, or detected on the surface, as BOP's models_info.json lists them."""
