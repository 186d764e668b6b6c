"""Errors, units, untrusted text, files, and records of documents; imports no other room."""
