"""Dataset tables: schema, metadata, reading, writing, selection."""
