"""Checks of pages, tables, docstrings, imports and the site."""
