"""Commands that reproduce the documents' measurements and tables."""
