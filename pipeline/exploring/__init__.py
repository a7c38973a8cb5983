"""Explores a filter by hand: a local page whose sliders replay a log while they are dragged.

`session.py` holds a log and the filters on it, without server or browser: begin there. `page.py` binds
it to widgets and plots, `serving.py` shows the page to this machine alone.
"""
