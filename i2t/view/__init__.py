"""The page of `i2t view` in the browser, and recordings as files for others.

`server` serves the page, whose scenes are `explore`, `recognize`, `replay` and `live`. `contents` reads recorded
touches, which `replay` shows, and which `page` (HTML) and `rerun_file` (Rerun) write.
"""
