"""Explores a filter by hand: a local page whose sliders replay a log while they are dragged.

Begin with `session`: a log and the filters on it, without server or browser. `page` binds it to widgets
and plots, `serving` shows the page to this machine alone.
"""
