"""Viewer of recordings: `python -m i2t.view DIR` writes a Rerun recording and a page of a session or data set.

`i2t.view.contents` reads the folder and lists what is in it; `rerun_file` and `page` each write that list.
"""
