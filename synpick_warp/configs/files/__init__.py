"""Settings files: loading, tables and lists of tables, serialization."""
