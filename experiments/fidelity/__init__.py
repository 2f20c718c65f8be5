"""What a recording of a skin is worth: one report for any of them."""
