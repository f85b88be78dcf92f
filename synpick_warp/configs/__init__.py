"""Configuration: schema, presets, loading, validation."""
