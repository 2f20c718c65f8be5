"""The measurements of the documents again, and the tables that the documents show."""
