"""Checks of the project's text: pages, tables, docstrings, imports and the site."""
