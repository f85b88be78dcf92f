"""Validation across settings."""
