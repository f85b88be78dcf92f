"""Validation of BOP data sets: rules about files, annotations, masks, models, and poses against re-rendered views."""
