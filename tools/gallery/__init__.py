"""Figures of the documents, made by one command."""
