"""Evaluation of pose estimates: BOP result files, ADD and ADD-S, AUC, tracking filter, tables and plots."""
