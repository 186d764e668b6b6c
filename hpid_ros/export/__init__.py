"""A joint's loop as source of another language: settings in, texts out, without files."""
