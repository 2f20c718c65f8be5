"""Viewer of recordings: `i2t view DIR` writes a session or data set as a Rerun recording and an HTML page.

`i2t.view.contents` reads the folder and lists its contents, which `rerun_file` and `page` each write.
"""
