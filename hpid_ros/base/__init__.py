"""Foundations that every room stands on: errors, names, text, files, signals."""
