"""A dataset as tables: schema, metadata, reading, writing, selection."""
