"""Worth of a recording of a skin: one report for any of them."""
