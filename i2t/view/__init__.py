"""Viewer of recordings: `python -m i2t.view DIR` writes a Rerun recording and a page of a session or data set.

`i2t.view.contents` reads the folder, `i2t.view.rerun_file` writes the recording, `i2t.view.page` the page.
"""
