"""Interactive exploration of a filter: a local page whose sliders replay a log while they are dragged.

Begin with `session`: a log and the filters on it, without server or browser. `page` binds it to widgets
and plots, `serving` serves the page to this machine only.
"""
