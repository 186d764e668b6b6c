"""Configuration files: YAML, sections with checked keys, documents that extend others."""
