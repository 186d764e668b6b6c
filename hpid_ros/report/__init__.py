"""Comparisons for people: tables, figures and a web page."""
